"""An export in, a picture out: how its networks agree with those of the runs, and what takes how much room."""

from __future__ import annotations

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from topological_nav.weights.export import PRECISION, Exported


def export_figure(made: Exported, limit_mib: float) -> Figure:
    """Three panels: distances of embeddings, probabilities of passages, sizes.

    Args:
        made: of `export.export`.
        limit_mib: that it had to keep to.
    """
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    compared = made.compared
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
    parts = sorted(made.sizes.items(), key=lambda item: item[1])
    total = sum(made.sizes.values()) / 2**20
    right.barh([name for name, _ in parts] + ["all"], [size / 2**20 for _, size in parts] + [total])
    right.axvline(limit_mib, color="tab:red", lw=1)
    right.set(xlabel=f"MiB (at most {limit_mib:g}, the line)")
    return figure
