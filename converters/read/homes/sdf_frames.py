"""Resolve the poses of an SDF world or model, which may be given in any frame that has a name."""

import dataclasses
import xml.etree.ElementTree as ElementTree

import numpy as np
import trimesh

from converters.read.urdf import numbers
from converters.records.errors import SceneRejected
from interactive_nav_common.rotations import matrix_from_quat

EULER, QUATERNION = (0.0,) * 6, (0.0,) * 6 + (1.0,)


@dataclasses.dataclass
class Frames:
    """The frames of one world or model; poses are in its own frame."""

    where: str
    """Names the world or model in errors."""
    itself: str = "__model__"
    """Its own frame's name."""
    given: dict[str, tuple[str, np.ndarray]] = dataclasses.field(default_factory=dict)
    """Name -> the frame that its (4, 4) pose is given in, and that pose."""
    inner: dict[str, "Frames"] = dataclasses.field(default_factory=dict)
    """Model within -> its frames."""
    placed: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Start with the frame that all others hang on."""
        self.placed |= {"": np.eye(4), self.itself: np.eye(4)}

    def add(self, name: str | None, pose: ElementTree.Element | None, default: str = "") -> None:
        """Add a frame whose pose is given in another one: `default`, unless the pose names one."""
        self.given[name or ""] = _named(pose) or default, self.matrix(pose)

    def add_model(
        self, name: str, pose: ElementTree.Element | None, frames: "Frames", placement: str | None
    ) -> tuple[str, np.ndarray]:
        """Add a model within, whose pose is that of its frame `placement`; return the frame and pose it is given in."""
        matrix = self.matrix(pose) @ np.linalg.inv(frames.pose((placement or "").strip()))
        self.given[name], self.inner[name] = (_named(pose), matrix), frames
        return self.given[name]

    def pose(self, name: str) -> np.ndarray:
        """Return the (4, 4) pose of a frame; `model::frame` is one of a model within."""
        steps: dict[str, np.ndarray] = {}
        while name not in self.placed:
            head, _, rest = name.partition("::")
            if name in steps:
                raise SceneRejected(f"{self.where}: its frame '{name}' is given relative to itself; mend its pose")
            if name in self.given:
                following, steps[name] = self.given[name]
            elif rest and head in self.inner:
                following, steps[name] = head, self.inner[head].pose(rest)
            else:
                raise SceneRejected(
                    f"{self.where}: a pose is relative to '{name}', which is no frame there, "
                    f"expected one of {', '.join(sorted(self.given)[:8]) or 'none'}; mend the pose"
                )
            name = following
        at = self.placed[name]
        for each, matrix in reversed(steps.items()):
            at = self.placed[each] = at @ matrix
        return at

    def place(self, pose: ElementTree.Element | None, default: np.ndarray) -> np.ndarray:
        """Return the (4, 4) of a pose that is relative to the frame `default` unless it names another."""
        name = _named(pose)
        return (self.pose(name) if name else default) @ self.matrix(pose)

    def matrix(self, pose: ElementTree.Element | None) -> np.ndarray:
        """Return the (4, 4) of x y z and roll pitch yaw, or a quaternion, in the frame that the pose is given in."""
        if pose is None:
            return np.eye(4)
        kind = pose.get("rotation_format", "euler_rpy")
        if kind not in ("euler_rpy", "quat_xyzw"):
            raise SceneRejected(f"{self.where}: rotation_format is '{kind}', expected euler_rpy or quat_xyzw")
        try:
            values = numbers(pose.text, EULER if kind == "euler_rpy" else QUATERNION)
        except ValueError as error:
            raise SceneRejected(f"{self.where}: {error}") from error
        matrix = np.eye(4)
        if kind == "quat_xyzw":
            length = float(np.linalg.norm(values[3:]))
            if length < 1e-6:
                raise SceneRejected(f"{self.where}: the quaternion of a pose is 0 0 0 0, expected a rotation")
            matrix[:3, :3] = matrix_from_quat(values[[6, 3, 4, 5]] / length)
        else:
            turn = np.radians(values[3:]) if pose.get("degrees") in ("true", "1") else values[3:]
            matrix = trimesh.transformations.euler_matrix(*turn, axes="sxyz")
        matrix[:3, 3] = values[:3]
        return matrix


def _named(pose: ElementTree.Element | None) -> str:
    """Return the name of the frame that a pose is relative to; empty for the default."""
    return "" if pose is None else (pose.get("relative_to") or pose.get("frame") or "").strip()
