"""Furniture found in a labelled scan, and CAD models retrieved for it (section III-B)."""
