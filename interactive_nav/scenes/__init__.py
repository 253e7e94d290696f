"""Scene folders in, MuJoCo models of equal layout out."""
