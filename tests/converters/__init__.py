"""Tests of the scene converter."""
