"""Draw runs of transfer and exports: domains side by side, learning, scores; an export beside its runs."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from interactive_nav_common.figures import BLUE, ORANGE, RC, VERMILION, curves, panels, parts, plt
from topological_nav.weights.export import PRECISION, Compared

_SHOWN = 6
"""Pairs of images."""
_STAGES = {"before": "0.6", "statistics": ORANGE, "after": BLUE}


@plt.rc_context(RC)  # type: ignore[reportCallIssue]
def features_figure(
    source: np.ndarray, target: np.ndarray, lines: Sequence[Mapping[str, Any]], results: Mapping[str, Any]
) -> Figure:
    """Draw images [n, H, W, 3] u8 of both domains, the game's course, and localisation before and after."""
    figure, course, scores = _domains(source, target)
    course.axhline(0.5, color="0.5", linewidth=0.8, zorder=0, label="accuracy by chance")
    labels = {"loss": "extractor's loss", "critic_loss": "critic's loss", "critic_accuracy": "critic's accuracy"}
    curves(course, lines, labels, marker=".")
    course.set(ylim=(0, max(1.0, course.get_ylim()[1])), title="adaptation: losses (nats), accuracy (share)")
    kinds = (("node", "nearest node"), ("room", "right room"))
    for k, (name, colour) in enumerate(_STAGES.items()):
        values = [results[name]["mean"][kind] for kind, _ in kinds]
        _bars(scores, np.arange(2) + 0.27 * (k - 1), values, 0.25, colour, name)
    for x, (kind, _) in enumerate(kinds):
        best = results["source"]["mean"][kind]
        scores.plot([x - 0.45, x + 0.45], [best, best], "k--", linewidth=1, label="in the source" if not x else None)
    title = "share of the target's held-out images localised"
    scores.set(xticks=[0, 1], xticklabels=[label for _, label in kinds], ylim=(0, 1), title=title)
    scores.legend(loc="upper left")
    return figure


@plt.rc_context(RC)  # type: ignore[reportCallIssue]
def passages_figure(
    source: np.ndarray, target: np.ndarray, lines: Sequence[Mapping[str, Any]], results: Mapping[str, Any]
) -> Figure:
    """Draw images of both domains, fine-tuning, and accuracy of the four configurations; see `features_figure`."""
    figure, course, scores = _domains(source, target)
    for name, label in (("B", "B: fresh weights"), ("D", "D: the source's")):
        curves(course, [line for line in lines if line["phase"] == name], {"accuracy": label}, marker=".")
    course.set(xlabel="epoch of fine-tuning", ylim=(0, 1), title="accuracy on the images learned from")
    _bars(scores, np.arange(4), [results[name]["accuracy"] for name in "ABCD"], 0.6, BLUE, None)
    scores.axhline(0.5, color="0.5", linewidth=0.8)
    words = ("A\nfresh", "B\nfresh,\nfine-tuned", "C\nsource", "D\nsource,\nfine-tuned")
    title = f"accuracy on {results['tested_on']} held-out target images"
    scores.set(xticks=range(4), xticklabels=words, ylim=(0, 1), title=title)
    return figure


def _domains(source: np.ndarray, target: np.ndarray) -> tuple[Figure, Axes, Axes]:
    """Return a figure with images of both domains, and its axes for the course of learning and for the scores."""
    figure, (above, below) = parts((8, 5.6), [1.0, 1.15])
    grid = above.subplots(2, _SHOWN, squeeze=False)
    for line, images, name in zip(grid, (source, target), ("as rendered", "target"), strict=True):
        rows = np.linspace(0, len(images) - 1, _SHOWN).astype(int)
        for axis, row in zip(line, rows, strict=True):
            axis.imshow(images[row])
            axis.set_axis_off()
        line[0].set_title(name, loc="left")
    return figure, *below.subplots(1, 2)


def _bars(axis: Axes, at: np.ndarray, values: Sequence[float], width: float, colour: str, label: str | None) -> None:
    bars = axis.bar(at, values, width, color=colour, label=label)
    axis.bar_label(bars, fmt="%.2f", fontsize=8)


def export_figure(sizes: Mapping[str, int], compared: Compared, limit_mib: float) -> Figure:
    """Draw three panels: distances of embeddings, probabilities of passages, sizes."""
    figure, ((left, middle, right),) = panels((13, 3.8), 1, 3)
    rows = [("by precision, localiser", compared.embedding[0]), ("by precision, detector", compared.embedding[1])]
    if (compared.apart > 0).any():
        rows.append(("to the nearest image of another place", compared.apart))
    floor = 1e-7
    shown = [np.maximum(values, floor) for _, values in rows]
    low, high = np.log10(min(v.min() for v in shown)), np.log10(max(v.max() for v in shown))
    bins = np.logspace(low - 0.05, high + 0.05, 60)
    for (name, _), values in zip(rows, shown, strict=True):
        left.hist(values, bins, alpha=0.65, label=name)  # type: ignore[arg-type]
    left.set(xscale="log", xlabel="distance of embeddings", ylabel="images")
    left.set_ylim(0, 1.35 * left.get_ylim()[1])
    left.legend(fontsize=8, loc="upper center")
    middle.plot([0, 1], [0, 1], color="0.7", lw=1)
    middle.scatter(*compared.probability.reshape(2, -1), s=8, alpha=0.6)
    middle.set(xlabel="probability of a passage, the run", ylabel=f"the same, {PRECISION}", aspect="equal")
    parts = sorted(sizes.items(), key=lambda item: item[1])
    total = sum(sizes.values()) / 2**20
    right.barh([name for name, _ in parts] + ["all"], [size / 2**20 for _, size in parts] + [total])
    right.axvline(limit_mib, color=VERMILION, lw=1)
    right.set(xlabel=f"MiB (at most {limit_mib:g}, the line)")
    return figure
