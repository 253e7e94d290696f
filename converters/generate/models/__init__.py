"""CAD furniture of convex parts."""
