"""Build topological maps, plan on them, and localise images in them."""
