"""Label the vertices of unlabelled scans: a small volumetric network, its training and its scores."""
