"""What runs have written, drawn: metrics, rows and recorded paths in; pictures and tables out."""

from train.figures.cli import figures_of, main
from train.figures.curves import cell_curves, learning_curves
from train.figures.paths import trajectories
from train.figures.scores import frontier

__all__ = ["cell_curves", "figures_of", "frontier", "learning_curves", "main", "trajectories"]
