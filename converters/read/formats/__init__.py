"""File formats whose libraries drop what changes place or colour."""
