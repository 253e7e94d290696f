"""Aligned CAD models in, movable bodies out: poses, hulls, masses."""
