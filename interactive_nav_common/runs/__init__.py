"""Write and read the files of runs: weights."""
