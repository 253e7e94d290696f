"""Find furniture in a labelled scan, and retrieve CAD models for it (section III-B)."""
