"""Infer settings of `from_file` for a bare URDF or MJCF file from the YAML file beside it and from the file itself."""

import dataclasses
import re
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from interactive_nav.robots.factory import from_file
from interactive_nav.robots.files import compiled, read_file, warn
from interactive_nav.robots.joints import FLOOR_M
from interactive_nav.robots.repair import slip_torque_n_m, strip
from interactive_nav.robots.spec import RobotSpec
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.records import Reader

_GEOM = mujoco.mjtGeom
_MAPPINGS = dict.fromkeys(("joints", "home", "torque_limits"), dict[str, float] | None)
_Sidecar = dataclasses.make_dataclass(
    "_Sidecar",
    [
        (name, hint, dataclasses.field(default=None))
        for name, hint in (typing.get_type_hints(from_file) | _MAPPINGS).items()
        if name not in ("path", "return")
    ],
)
"""The keys of `porter.yaml` beside `porter.urdf`."""
_READER = Reader(ConfigError, "expected settings of interactive_nav.robots.from_file")
_FASTEST_M_S, _DEFAULT_M_S = 3.0, 1.0
"""Of wheels: a limit above the first is taken for a placeholder, and the second instead."""


@dataclasses.dataclass(frozen=True)
class _Round:
    """A link that stands on the floor as a sphere, capsule or cylinder."""

    body: str
    joint: str
    """That turns it about y, its parent being fixed to the base; empty: none."""
    x_m: float
    y_m: float
    radius_m: float
    sphere: bool
    effort: float


def from_description(path: Path) -> Callable[[str], RobotSpec]:
    """Return the factory of a file's robot, named after the file."""
    given: dict[str, Any] = {}
    sidecar = path.with_suffix(".yaml")
    if sidecar.is_file():
        plain = _READER.decoded(sidecar.read_bytes(), "YAML", str(sidecar)) or {}
        given = {k: v for k, v in vars(_READER.record(plain, _Sidecar, str(sidecar))).items() if v is not None}
    name = re.sub(r"[^A-Za-z0-9_-]", "_", path.stem).lstrip("_-") or "robot"
    return from_file(path, **{"name": name, **_inferred(path, given)})


def _inferred(path: Path, given: dict[str, Any]) -> dict[str, Any]:
    """Complete the given settings by what the file shows."""
    spec = read_file(path, given.get("base_body", ""))
    speeds = _speed_limits(spec, path)
    tops = spec.worldbody.bodies
    tops = [b for b in tops if any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in b.joints)] or tops
    base = given.get("base_body") or tops[0].name if len(tops) == 1 else given.get("base_body", "")
    strip(spec, path, base)
    model = compiled(spec, path)
    stands = _on_floor(spec, model, base)
    wheels = [w for w in stands if w.joint]
    wheels = [w for w in wheels if w.effort > 0] or wheels
    wheels = [w for w in wheels if w.radius_m > max(w.radius_m for w in wheels) - 1e-3]
    sides = {
        side: tuple(w.joint for w in sorted(wheels, key=lambda w: -w.x_m) if w.y_m * sign > 0)
        for side, sign in (("left_wheels", 1), ("right_wheels", -1))
    }
    settings = {"base_body": base, **sides, **given}
    left, right = settings["left_wheels"], settings["right_wheels"]
    if not left or len(left) != len(right):
        hinges = [j.name for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_HINGE] or ["left_joint"]
        raise ConfigError(
            f"robot file {path}: {len(left)} wheels on the left and {len(right)} on the right stand on the floor and "
            f"turn about y, expected as many; name them in {path.stem}.yaml beside it, such as: {{base_body: {base}, "
            f"left_wheels: ['{hinges[0]}'], right_wheels: ['{hinges[-1]}'], max_wheel_speed_rad_s: 10}}"
        )
    driven = [w for w in stands if w.joint in (*left, *right)]
    fastest = min((speeds[joint] for joint in (*left, *right) if speeds.get(joint, 0.0) > 0), default=np.inf)
    if "max_wheel_speed_rad_s" not in settings:
        radius_m = driven[0].radius_m if driven else 1.0
        if fastest * radius_m > _FASTEST_M_S:
            warn(path, f"its wheels have no limit below {_FASTEST_M_S:g} m/s; {_DEFAULT_M_S:g} m/s is taken")
            fastest = _DEFAULT_M_S / radius_m
        settings["max_wheel_speed_rad_s"] = float(fastest)
    limits = given.get("torque_limits", {})
    weak = [w.joint for w in driven if not w.effort > 0 and w.joint not in limits]
    if weak:
        slip = slip_torque_n_m(model, driven[0].radius_m)
        warn(path, f"{', '.join(weak)} have no torque limit; {slip:.3g} N m is taken, at which wheels slip")
        settings["torque_limits"] = {**dict.fromkeys(weak, slip), **limits}
    settings.setdefault("casters", tuple(w.body for w in stands if w.sphere and w not in driven))
    return settings


def _speed_limits(spec: mujoco.MjSpec, path: Path) -> dict[str, float]:
    """Return the largest speed of joints, rad/s, as a URDF's limits or velocity servos declare it."""
    servos = {a.target: float(a.ctrlrange[1]) for a in spec.actuators if a.biasprm[2] < 0 and not a.biasprm[1]}
    limits = {j.get("name", ""): j.find("limit") for j in ElementTree.parse(path).getroot().iter("joint")}
    return servos | {name: float(x.get("velocity", 0)) for name, x in limits.items() if x is not None}


def _on_floor(spec: mujoco.MjSpec, model: mujoco.MjModel, base: str) -> list[_Round]:
    """Return the round links at the height of the lowest of those that turn about y, or of all."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    kinds = [int(k) for k in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER)]
    links: list[tuple[float, _Round]] = []
    for body in range(1, model.nbody):
        geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 3]
        if len(geoms) != 1 or model.geom_type[geoms[0]] not in kinds or model.body(body).name == base:
            continue
        (x, y, z), radius = data.geom_xpos[geoms[0]], float(model.geom_size[geoms[0], 0])
        joint, effort = "", 0.0
        fixed = model.body_weldid[model.body_parentid[body]] == model.body(base).id
        if fixed and model.body_jntnum[body] == 1:
            j = int(model.body_jntadr[body])
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and abs(data.xaxis[j, 1]) > 0.95:
                joint, effort = model.joint(j).name, float(spec.joint(model.joint(j).name).actfrcrange[1])
        sphere = model.geom_type[geoms[0]] == kinds[0]
        links.append((z - radius, _Round(model.body(body).name, joint, x, y, radius, sphere, effort)))
    floor = min((low for low, link in links if link.joint), default=-np.inf)
    return [link for low, link in links if abs(low - floor) < FLOOR_M]
