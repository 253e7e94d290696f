"""Define the environment, its batches and its devices."""
