"""Compute where a robot can go, from tables that are built once and looked up inside jit."""
