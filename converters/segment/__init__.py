"""Unlabelled scans in, NYU40 labels of their vertices out: a small volumetric network, its training and its scores."""
