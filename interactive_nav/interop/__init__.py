"""Offer the environment to other libraries: Gymnasium, Stable-Baselines3, PyTorch."""
