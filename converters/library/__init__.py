"""Furniture that people modelled: catalogues of it, a packaged selection, and how to build that."""
