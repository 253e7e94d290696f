"""Pictures of robots: to one scale where they are put side by side."""

from __future__ import annotations

import math

import numpy as np
import pytest

from docs.studies.robots import pictures
from interactive_nav.robots import get_robot


def test_pictures_to_scale_are_of_one_scale():
    """Freight is a cylinder 0.559 m wide: 200 pixels a metre, whatever the size of a robot."""
    cut = pictures.cut_out(pictures.picture(get_robot("freight"), "rays", to_scale=True))
    model, data = pictures.stage(get_robot("freight"))
    centre, _ = pictures._span(model, data)
    assert cut.shape[1] / 200 == pytest.approx(0.559, rel=0.05)
    assert cut.shape[0] / 200 == pytest.approx(
        2 * centre[2] * math.cos(math.radians(22)) + 0.559 * math.sin(math.radians(22)), rel=0.1
    )


def test_a_cut_holds_what_is_drawn_on_white():
    image = np.full((6, 8, 3), 10, np.uint8)
    image[2:4, 3:6] = 200
    image[2, 4] = 10
    cut = pictures.cut_out(image)
    assert cut.shape == (2, 3, 3)
    np.testing.assert_array_equal(cut[..., 0], [[200, 255, 200], [200, 200, 200]])


def test_the_gallery_names_robots_and_has_a_bar():
    figure = pictures.gallery(("freight", "turtlebot"), "rays")
    (axis,) = figure.axes
    assert [text.get_text() for text in axis.texts] == ["freight\n78.8 kg", "turtlebot\n2.67 kg", "0.5 m"]
    assert np.ptp(np.asarray(axis.lines[0].get_xdata(), float)) == pytest.approx(0.5)
