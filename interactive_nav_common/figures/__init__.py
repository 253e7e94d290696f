"""Draw all figures in one style: colours that colour-blind readers tell apart, panels, legends, means with intervals.

Colours are Okabe and Ito's (2008).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from interactive_nav_common.files import whole_file
from interactive_nav_common.records import read_packaged
from interactive_nav_common.statistics import Estimate

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

BLUE, ORANGE, GREEN, PINK, SKY, VERMILION = "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00"
RC: dict[Any, Any] = read_packaged(Path(__file__).with_name("style.yaml"), dict[str, Any])
"""What `plt.rc_context` takes to draw in this style."""
ANY = (-np.inf, np.inf)


def save(figure: Figure, path: Path, kind: str = "png", dpi: float | None = None) -> None:
    """Write a picture of a kind whole or not at all, and forget the figure; without `dpi` as the style says."""
    with whole_file(path) as partial:
        figure.savefig(partial, format=kind, dpi=dpi)
    plt.close(figure)


def panels(size: tuple[float, float], rows: int = 1, columns: int = 1, **more: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure and its axes [rows, columns]."""
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **more)


def parts(size: tuple[float, float], heights: Sequence[float]) -> tuple[Figure, Any]:
    """Return a figure and its parts, one above the other."""
    figure: Any = plt.figure(figsize=size, layout="constrained")
    return figure, figure.subfigures(len(heights), 1, height_ratios=heights)


def scene_axes(part: Any, count: int, columns: int = 4) -> np.ndarray:
    """Return [count] axes of a figure or a part of one, at most so many in a line."""
    columns = min(columns, count)
    axes = part.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.set_axis_off()
    return axes[:count]


def handle(label: str, **look: Any) -> Line2D:
    """Return a line of a legend."""
    return Line2D([], [], label=label, **{"markersize": 5, **look})


def legend(figure: Figure, handles: Sequence[Artist], columns: int | None = None, **more: Any) -> None:
    """Draw a legend below the panels."""
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns or len(handles), **more)


def curves(axis: Axes, lines: Sequence[Mapping[str, Any]], labels: Mapping[str, str], **look: Any) -> None:
    """Draw metrics (name -> label) of a run's lines over its epochs."""
    for name, label in labels.items():
        axis.plot([line["epoch"] for line in lines], [line[name] for line in lines], label=label, **look)
    axis.set_xlabel("epoch")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)


def draw_means(axis: Axes, x: Any, points: Sequence[Estimate], bounds: tuple[float, float] = ANY, **look: Any) -> None:
    """Draw means over runs as a line, and their intervals, as far as they lie within bounds, as a band."""
    axis.plot(x, [point.mean for point in points], **look)
    low, high = (np.clip([getattr(point, end) for point in points], *bounds) for end in ("low", "high"))
    axis.fill_between(x, low, high, color=look["color"], alpha=0.13, linewidth=0)
