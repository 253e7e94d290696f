"""Get robots by name: each is a typed spec (mass, width, action map, camera) and an MJCF builder."""

from collections.abc import Callable

from interactive_nav.robots.build import WHEELED
from interactive_nav.robots.factory import from_file
from interactive_nav.robots.models.legged import LEGGED
from interactive_nav.robots.models.quadrotor import quadrotor
from interactive_nav.robots.reference import A_FILE, is_reference, load_reference
from interactive_nav.robots.spec import RobotSpec
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError

_FACTORIES: dict[str, Callable[[str], RobotSpec]] = {**LEGGED, "quadrotor": quadrotor, **WHEELED}
"""Name -> control mode -> spec."""


def robot_names() -> tuple[str, ...]:
    """Return the names that `get_robot` accepts."""
    return tuple(sorted(_FACTORIES))


def get_robot(name: str, control_mode: str = "native") -> RobotSpec:
    """Return the spec of one of `robot_names()`, a URDF or MJCF file, or `path.py:function` (`docs/add-a-robot.md`).

    The control mode `native` is the original benchmark's action. Raise `ConfigError` for an unknown name or mode or an
    unusable file, and `FileError` for a file that lacks a part, or whose parts do not fit.
    """
    factory = _FACTORIES.get(str(name))
    if factory is None and is_reference(str(name)):
        factory = load_reference(str(name), _FACTORIES)
    if factory is None:
        near = nearest(str(name), list(_FACTORIES))
        names = ", ".join(robot_names())
        raise ConfigError(f"unknown robot '{name}'{near}; known robots: {names}; or {A_FILE}")
    return factory(control_mode)


def robot_name(robot: str) -> str:
    """Return the name of a robot, which of one that a file describes the file says."""
    return get_robot(robot).name if is_reference(robot) else robot


def register(name: str, factory: Callable[[str], RobotSpec]) -> None:
    """Register a user's robot, under a new name, for `make` and `get_robot` in this process.

    The factory maps control modes, `native` among them, to specs of that name; `from_file` returns one.
    """
    if name in _FACTORIES:
        raise ConfigError(f"robot '{name}' exists already; choose another name")
    spec = factory("native")
    if spec.name != name:
        raise ConfigError(f"the factory's robot is called '{spec.name}', expected '{name}'")
    _FACTORIES[name] = factory


__all__ = ["RobotSpec", "from_file", "get_robot", "register", "robot_name", "robot_names"]
