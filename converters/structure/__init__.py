"""Scan in; levelled floor, scan without furniture, maps and wall boxes out."""
