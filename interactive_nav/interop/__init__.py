"""The environment for other libraries: Gymnasium, Stable-Baselines3, PyTorch."""
