"""A driver that turns to the world's x axis, or another heading, and drives along it; as a program, in a node."""

import math
import sys

from interactive_nav.ros.nodes import ros_node
from topological_nav.ros.nodes import NavigatorNode


class Turning:
    """Turns by 2 rad/s for each rad, 1 rad/s at most, to within 0.1 rad; then 0.5 m/s for 2 s, without looking."""

    lens = None

    def __init__(self, heading_rad=0.0):
        self._heading_rad, self._since = heading_rad, None

    def step(self, image, heading_rad, time_s):
        error = math.remainder(self._heading_rad - heading_rad, math.tau)
        turn = min(max(2.0 * error, -1.0), 1.0)
        if self._since is None and abs(error) > 0.1:
            return (0.0, turn), False
        self._since = time_s if self._since is None else self._since
        if time_s - self._since >= 2.0 - 1e-6:
            return (0.0, 0.0), True
        return (0.5, turn), False


if __name__ == "__main__":
    with ros_node("navigator") as node:
        sys.exit(0 if NavigatorNode(node, Turning()).run(lambda: False) else 1)  # type: ignore[arg-type]
