"""Turn aligned CAD models into movable bodies: poses, hulls, masses."""
