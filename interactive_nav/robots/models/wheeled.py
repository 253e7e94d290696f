"""The seven wheeled robots: `wheeled.yaml` in, one factory (control mode -> `RobotSpec`) a robot out.

Bodies and shapes: `mjcf/<robot>.xml`. Control modes: `native`, velocities of the wheels, left then right, front
before rear (Husky: their torques), an arm folded; `whole_body`, of a robot with an arm, its velocities too, and a
gripper's opening; `twist`, linear and angular velocity of the base, an arm folded; `velocity`, `position` or
`torque` of all joints.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

from interactive_nav.robots.build import WheeledBase, wheeled_robot
from interactive_nav.robots.spec import RobotCamera, RobotSpec
from interactive_nav_common.errors import FileError
from interactive_nav_common.records import Reader

FILE = Path(__file__).with_suffix(".yaml")


@dataclasses.dataclass(frozen=True)
class _Row:
    """A robot of the file: driven joints and commands, and other fields of its `RobotSpec`."""

    base: WheeledBase
    body_width_m: float
    footprint_radius_m: float
    height_m: float
    camera: RobotCamera
    mass_kg: float
    size_m: tuple[float, float, float]
    drive_type: str
    source: str


def _rows() -> tuple[_Row, ...]:
    reader = Reader(FileError, "install the package again")
    rows = reader.decoded(FILE.read_bytes(), "YAML", str(FILE))
    return reader.typed(rows, tuple[_Row, ...], str(FILE))


def _factory(row: _Row) -> Callable[[str], RobotSpec]:
    others = {f.name: getattr(row, f.name) for f in dataclasses.fields(row) if f.name != "base"}
    return functools.partial(wheeled_robot, row.base, **others)


WHEELED = {row.base.name: _factory(row) for row in _rows()}
"""Name -> control mode -> spec."""
