"""Build the factories (control mode -> `RobotSpec`) of the seven wheeled robots of `wheeled.yaml`.

Bodies and shapes: `mjcf/<robot>.xml`. Control modes: `native`, velocities of the wheels, left then right, front
before rear (Husky: their torques), an arm folded; `whole_body`, of a robot with an arm, its velocities too, and a
gripper's opening; `twist`, linear and angular velocity of the base, an arm folded; `velocity`, `position` or
`torque` of all joints.
"""

import dataclasses
import functools
from pathlib import Path

from interactive_nav.robots.build import WheeledBase, wheeled_robot
from interactive_nav.robots.spec import Figures
from interactive_nav_common.records import read_packaged


@dataclasses.dataclass(frozen=True)
class _Row(Figures):
    """A robot of the file."""

    base: WheeledBase
    """Driven joints and commands."""


WHEELED = {
    row.base.name: functools.partial(wheeled_robot, **vars(row))
    for row in read_packaged(Path(__file__).with_suffix(".yaml"), tuple[_Row, ...])
}
"""Name -> control mode -> spec."""
