"""The navigator behind the interface of a driver."""

from types import SimpleNamespace

import numpy as np
import pytest

from scenes_mjcf.look import Lens
from topological_nav.ros.drivers import PilotDriver


class Three:
    """A navigator that is done at its third step."""

    def __init__(self, how):
        self.how, self.asked = how, []

    def step(self, state, images, heading_rad, time_s):
        self.asked.append((images.shape, heading_rad.tolist(), time_s.tolist()))
        over = np.array([len(self.asked) == 3])
        velocity = {"linear": np.array([0.3]), "angular": np.array([-0.2])}
        events = {"arrived": np.array([False]), "timed_out": np.array([False]), self.how: over}
        return SimpleNamespace(number=state.number + 1, **velocity, **events)


@pytest.mark.parametrize("how", ["arrived", "timed_out"])
def test_the_navigator_is_asked_as_a_batch_of_one_and_ends_the_episode(how):
    navigator, lens = Three(how), Lens(4, 3, 90.0)
    driver = PilotDriver(navigator, SimpleNamespace(number=0), lens)  # type: ignore[arg-type]
    commands = [driver.step(np.zeros((3, 4, 3), np.uint8), 0.5, 1.0 + 0.1 * k) for k in range(3)]
    assert commands == [((0.3, -0.2), False), ((0.3, -0.2), False), ((0.0, 0.0), True)]
    assert (
        driver._state.number == 3
        and navigator.asked == [((1, 3, 4, 3), [0.5], [1.0 + 0.1 * k]) for k in range(3)]
        and driver.lens is lens
    )
