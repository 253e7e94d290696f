"""Homes that others made for their simulators: placed parts instead of a scan."""
