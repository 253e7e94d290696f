"""What every package here needs and none owns: whole-file writes, locks, errors, settings, rows, statistics.

A leaf: it imports no other package of the project.
"""
