"""Score policies as rows of episodes."""
