"""Define the records that readers fill and stages take."""
