"""The navigator as a driver, made of the toy scene's networks and map."""

import math

import numpy as np
import pytest
from PIL import Image

from interactive_nav_common.errors import ConfigError, FileError
from topological_nav.config import NavigatorConfig
from topological_nav.data.dataset import load_rooms
from topological_nav.learn.training import load_trained
from topological_nav.maps.graph import load_map
from topological_nav.ros.__main__ import main
from topological_nav.ros.drivers import topological_driver
from topological_nav.weights.export import choose


def seeing(made):
    return choose(made.rooms, made.passages, "passage")


@pytest.fixture(scope="module")
def goal(made, tmp_path_factory):
    """A picture of the right room, along the world's x axis, twice as large as the networks' images."""
    rooms = load_rooms(made.data)
    row = int(np.argmax(rooms.xy_w[:, 0]))
    path = tmp_path_factory.mktemp("goal") / "goal.png"
    Image.fromarray(rooms.images[row, 1, 0].repeat(2, 0).repeat(2, 1)).save(path)
    return path, rooms.images[row, 1, 0]


def test_the_goal_is_the_node_that_looks_like_its_picture(made, goal):
    driver = topological_driver(made.map, seeing(made), (goal[0],), 0.0, NavigatorConfig(match="aligned"))
    read, trained = load_map(made.map), load_trained(made.rooms)
    away = np.linalg.norm(read.embeddings[:, 0] - trained.embed(goal[1][None])[0], axis=-1)
    assert driver._state.goal.tolist() == [int(away.argmin())]  # type: ignore[attr-defined]
    assert driver.lens is not None and (driver.lens.width, driver.lens.height) == goal[1].shape[1::-1]
    # It begins with a look about: on the spot, to the nearest of the map's headings, and then 20 degrees on.
    (linear, angular), done = driver.step(goal[1], math.radians(5), 0.0)
    assert (linear, done) == (0.0, False) and angular < 0
    assert driver.step(goal[1], 0.0, 0.1)[0][1] > 0


def test_out_of_time_it_is_done(made, goal):
    driver = topological_driver(made.map, seeing(made), (goal[0],), 0.0, NavigatorConfig(limit_s=1.0))
    assert not driver.step(goal[1], 0.5, 10.0)[1]
    assert driver.step(goal[1], 0.5, 11.0)[1]


def test_what_is_missing_is_told(made, tmp_path, capsys):
    with pytest.raises(ConfigError, match="no goal; name a picture"):
        topological_driver(made.map, seeing(made), (), 0.0, NavigatorConfig())
    (tmp_path / "goal.png").write_text("no")
    with pytest.raises(FileError, match="goal.png: not readable .*; take it again, or leave it out"):
        topological_driver(made.map, seeing(made), (tmp_path / "goal.png",), 0.0, NavigatorConfig())
    assert main([]) == 2
    assert "missing --map" in capsys.readouterr().err
