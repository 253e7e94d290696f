"""Resolve the poses of an SDF world and its models, which may be given in any frame that has a name."""

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

from converters.read.urdf import numbers
from converters.records.errors import SceneRejected
from interactive_nav_common.rotations import matrix_from_quat, transform


@dataclasses.dataclass
class Model:
    """A model, or the world, with its named frames and the models within it."""

    name: str
    element: ElementTree.Element
    path: Path
    static: bool = False
    models: list["Model"] = dataclasses.field(default_factory=list)
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(4))
    """(4, 4) in the frame of the model or world that it is in."""
    given: dict[str, tuple[str, np.ndarray]] = dataclasses.field(default_factory=dict)
    """Frame -> the frame that its (4, 4) pose is given in, and that pose."""
    placed: dict[str, np.ndarray] = dataclasses.field(
        default_factory=lambda: {"": np.eye(4), "world": np.eye(4), "__model__": np.eye(4)}
    )
    """Frame -> its (4, 4) pose in the frame of this one, once it is resolved."""

    def add_frames(self) -> None:
        """Add the frames of links, joints and `<frame>`; those stand for themselves unless their poses name others."""
        for child in self.element:
            if child.tag in ("link", "frame", "joint"):
                on = {"frame": child.get("attached_to"), "joint": child.findtext("child")}.get(child.tag) or ""
                pose = child.find("pose")
                self.given[child.get("name") or ""] = _frame(pose) or on.strip(), self.matrix(pose)

    def add_models(self, models: list[tuple["Model", ElementTree.Element | None, str]]) -> None:
        """Add models within; each pose is that of a frame in the model, or of the model itself."""
        for model, pose, placement in models:
            self.given[model.name] = _frame(pose), self.matrix(pose) @ np.linalg.inv(model.frame(placement))
            self.models.append(model)
        for model, pose, placement in models:
            model.pose = self.place(pose, np.eye(4)) @ np.linalg.inv(model.frame(placement))
        for element in self.element.findall("frame"):
            self.frame(element.get("name") or "")

    def frame(self, name: str) -> np.ndarray:
        """Return the (4, 4) pose of a frame; `model::frame` is one of a model within."""
        steps: dict[str, np.ndarray] = {}
        while name not in self.placed:
            head, _, rest = name.partition("::")
            within = [model for model in self.models if model.name == head]
            if name in steps:
                raise SceneRejected(f"{self.path}: frame '{name}' is given relative to itself; mend its pose")
            if name in self.given:
                following, steps[name] = self.given[name]
            elif rest and within:
                following, steps[name] = head, within[0].frame(rest)
            else:
                raise SceneRejected(
                    f"{self.path}: a pose in '{self.name}' is relative to '{name}', which is no frame there, expected "
                    f"one of {', '.join(sorted(self.given)[:8]) or 'none'}; mend the pose"
                )
            name = following
        at = self.placed[name]
        for each, matrix in reversed(steps.items()):
            at = self.placed[each] = at @ matrix
        return at

    def place(self, pose: ElementTree.Element | None, default: np.ndarray) -> np.ndarray:
        """Return the (4, 4) of a pose that is relative to the frame at `default` unless it names another."""
        name = _frame(pose)
        return (self.frame(name) if name else default) @ self.matrix(pose)

    def matrix(self, pose: ElementTree.Element | None) -> np.ndarray:
        """Return the (4, 4) of x y z and roll pitch yaw, or a quaternion, in the frame that the pose is given in."""
        if pose is None:
            return np.eye(4)
        quaternion = {"euler_rpy": False, "quat_xyzw": True}.get(pose.get("rotation_format", "euler_rpy"))
        try:
            values = numbers(pose.text, (0.0,) * 6 + (1.0,) * bool(quaternion))
        except ValueError as error:
            raise SceneRejected(f"{self.path}: '{self.name}': {error}") from error
        length = float(np.linalg.norm(values[3:]))
        if quaternion is None or (quaternion and length < 1e-6):
            form = f"{pose.get('rotation_format')} {values[3:].tolist()}"
            raise SceneRejected(f"{self.path}: '{self.name}' is turned by {form}, expected euler_rpy or quat_xyzw")
        if quaternion:
            return transform(matrix_from_quat(values[[6, 3, 4, 5]] / length), values[:3])
        rpy = np.radians(values[3:]) if pose.get("degrees") in ("true", "1") else values[3:]
        return transform(trimesh.transformations.euler_matrix(*rpy, axes="sxyz")[:3, :3], values[:3])


def _frame(pose: ElementTree.Element | None) -> str:
    """Return the name of the frame that a pose is relative to; empty for the default."""
    return "" if pose is None else (pose.get("relative_to") or pose.get("frame") or "").strip()
