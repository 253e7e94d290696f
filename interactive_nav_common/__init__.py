"""Provide what every package here shares: whole-file writes, locks, errors, settings, rows, statistics.

A leaf: it imports no other package of the project.
"""
