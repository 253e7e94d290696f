"""The environment, its batches and its devices."""
