"""Write and read the files of runs: settings, metrics, checkpoints, weights."""
