"""Build CAD furniture of convex parts."""
