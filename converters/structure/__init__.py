"""Level a scan's floor, cut its furniture out, and compute maps and wall boxes."""
