"""Load robots that a file describes, `porter.urdf`, `porter.xml` or `path.py:function`; keep them in run folders."""

import dataclasses
import hashlib
import inspect
import json
import os
import re
import shutil
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import mujoco
import numpy as np

from interactive_nav.robots.build import solid_geoms
from interactive_nav.robots.factory import from_file
from interactive_nav.robots.files import compiled, read_file, warn
from interactive_nav.robots.repair import FLOOR_M, slip_torque_n_m, strip
from interactive_nav.robots.spec import RobotSpec
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.files import write_text, writing
from interactive_nav_common.imports import import_function
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
    # Largest speeds of joints, rad/s, as a URDF's limits or velocity servos declare them.
    servos = {a.target: float(a.ctrlrange[1]) for a in spec.actuators if a.biasprm[2] < 0 and not a.biasprm[1]}
    limits = {j.get("name", ""): j.find("limit") for j in ElementTree.parse(path).getroot().iter("joint")}
    speeds = servos | {name: float(x.get("velocity", 0)) for name, x in limits.items() if x is not None}
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


def _on_floor(spec: mujoco.MjSpec, model: mujoco.MjModel, base: str) -> list[_Round]:
    """Return the round links at the height of the lowest of those that turn about y, or of all."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    kinds = [int(k) for k in (_GEOM.mjGEOM_SPHERE, _GEOM.mjGEOM_CAPSULE, _GEOM.mjGEOM_CYLINDER)]
    links: list[tuple[float, _Round]] = []
    for body in range(1, model.nbody):
        geoms = solid_geoms(model, body)
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


Factory = Callable[[str], RobotSpec]
ENDINGS = (".urdf", ".xml", ".mjcf", ".xacro", ".sdf", ".py")
A_FILE = "a URDF or MJCF file, or path/to/file.py:function"
_LOADED: dict[str, Factory] = {}


@dataclasses.dataclass(frozen=True)
class _Record:
    """What a run folder keeps of its robot."""

    reference: str
    """Relative to the folder where the files were copied into it."""
    identity: str


def is_reference(robot: str) -> bool:
    """Return whether a robot is given by a file instead of a name."""
    return ".py:" in robot or Path(robot).suffix.lower() in ENDINGS


def _split(reference: str) -> tuple[Path, str]:
    """Return a reference's file and, of a Python file, its `:function`."""
    path, colon, function = reference.rpartition(":") if ".py:" in reference else (reference, "", "")
    return Path(os.path.realpath(path)), colon + function  # which takes a circle of links, too


def _files(path: Path) -> list[Path]:
    """Return the file of a robot and, if there is one, the YAML file beside it."""
    sidecar = path.with_suffix(".yaml")
    return [path, sidecar] if path.suffix != ".py" and sidecar.is_file() else [path]


def identity(robot: str) -> str:
    """Return the name of a robot, or the name and digest of the file that describes it."""
    if not is_reference(robot):
        return robot
    path, function = _split(robot)
    if not path.is_file():
        raise ConfigError(f"robot file {path} does not exist, expected {A_FILE}; to play a run, give env.robot=PATH")
    contents = b"".join(hashlib.sha256(file.read_bytes()).digest() for file in _files(path))
    return f"{path.name}{function}, sha256 {hashlib.sha256(contents).hexdigest()[:16]}"


def load_reference(reference: str, registry: Mapping[str, Factory]) -> Factory:
    """Return the control mode -> spec of a file's robot; each content is read, and warned of, once."""
    path, function = _split(reference)
    key = f"{path.parent}/{identity(reference)}"
    if key not in _LOADED:
        factory = _of_python(path, function, registry) if path.suffix == ".py" else from_description(path)
        name = factory("native").name
        if registry.get(name, factory) is not factory:
            raise ConfigError(f"robot file {path}: robot '{name}' exists already; rename the file, or set its name")
        _LOADED[key] = lambda mode: dataclasses.replace(factory(mode), reference=f"{path}{function}")
    return _LOADED[key]


def _of_python(path: Path, function: str, registry: Mapping[str, Factory]) -> Factory:
    """Return the factory that a Python function is, returns or registers."""
    registered = set(registry)
    factory = import_function(f"{path}{function or ':'}", "robot", f"expected {A_FILE}", ConfigError)
    try:
        needed = [p for p in inspect.signature(factory).parameters.values() if p.default is p.empty]
        out: Any = factory if needed else factory()
        new = set(registry) - registered
        out = factory if isinstance(out, RobotSpec) else registry[new.pop()] if out is None and len(new) == 1 else out
        spec = out("native") if callable(out) else out
    except UserError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise ConfigError(f"robot {path}{function}: raised {reason}") from error
    if not (callable(out) and isinstance(spec, RobotSpec)):
        raise ConfigError(
            f"robot {path}{function}: gave type {type(spec).__name__}, expected a RobotSpec for a control mode, or "
            "what from_file returns"
        )
    return cast(Factory, out)


def record_robot(robot: str, folder: Path) -> None:
    """Record a robot in a run's folder: a file that names no others is copied there."""
    if not is_reference(robot) or folder.exists():
        return
    path, function = _split(robot)
    alone = path.suffix != ".py" and b"file=" not in path.read_bytes()
    record = _Record(path.name if alone else f"{path}{function}", identity(robot))
    with writing(folder, "make room, or set run.out_dir"):
        folder.mkdir(parents=True)
        for file in _files(path) if alone else ():
            shutil.copyfile(file, folder / file.name)
    write_text(folder / "reference.json", json.dumps(dataclasses.asdict(record), indent=1) + "\n")


def recorded_robot(folder: Path) -> tuple[str, str] | None:
    """Return the reference and the identity of a run's robot, and warn of a change; None for one that has a name."""
    path = folder / "reference.json"
    if not path.is_file():
        return None
    reader = Reader(ConfigError, "fetch the run again")
    record = reader.record(reader.json(path), _Record, str(path))
    reference = str(folder / record.reference)
    if _split(reference)[0].is_file() and identity(reference) != record.identity:
        now = "results are of the file as it is now"
        warn(folder, f"{Path(reference).name} changed since the run began ({record.identity}); {now}")
    return reference, record.identity
