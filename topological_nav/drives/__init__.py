"""Simulate the expert's drives, and train the local policy on them."""
