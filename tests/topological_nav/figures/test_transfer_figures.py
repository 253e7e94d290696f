"""Pictures of what transfer did: the courses, and the bars of each stage."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from topological_nav.figures.learning import features_figure

IMAGES = np.zeros((7, 8, 8, 3), np.uint8)


def heights(axis: Any) -> list[float]:
    return [bar.get_height() for bar in axis.patches]


def values(line: Any) -> list[float]:
    return list(line.get_ydata())


def test_localisation_before_and_after_stands_beside_the_source():
    lines = [{"epoch": k, "loss": 1.0 - 0.1 * k, "critic_loss": 0.7, "critic_accuracy": 0.5} for k in range(3)]
    means = {"before": (0.2, 0.4), "statistics": (0.3, 0.5), "after": (0.6, 0.7), "source": (0.9, 0.95)}
    results = {name: {"mean": {"node": node, "room": room}} for name, (node, room) in means.items()}
    figure = features_figure(IMAGES, IMAGES + 255, lines, results)
    shown: Any = figure.axes[:-2]
    course, scores = figure.axes[-2:]
    assert [axis.images[0].get_array().max() for axis in shown] == [0] * 6 + [255] * 6
    chance, loss, *_ = course.lines
    assert values(chance)[0] == 0.5 and values(loss) == [1.0, 0.9, 0.8]
    assert heights(scores) == [0.2, 0.4, 0.3, 0.5, 0.6, 0.7]
    assert [values(line)[0] for line in scores.lines] == [0.9, 0.95]
    plt.close("all")
