"""Furniture that people modelled: catalogues of it, a packaged selection, and how that is made."""
