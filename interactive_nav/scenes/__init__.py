"""Build MuJoCo models of equal layout from scene folders."""
