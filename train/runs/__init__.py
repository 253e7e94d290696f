"""Write run folders for configs, and read them back."""

STEP = 0.5
"""Step to which large weights are rounded, in standard deviations of an output's weights: about 3 bits a weight."""
