"""Load robots that a file describes, `porter.urdf`, `porter.xml` or `path.py:function`; keep them in run folders."""

import dataclasses
import hashlib
import inspect
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

from interactive_nav.robots.factory import Facts, from_file
from interactive_nav.robots.files import names_files, warn
from interactive_nav.robots.spec import RobotSpec
from interactive_nav_common.errors import ConfigError, UserError
from interactive_nav_common.files import write_json, writing
from interactive_nav_common.imports import import_function
from interactive_nav_common.records import Reader

_READER = Reader(ConfigError, "expected settings of interactive_nav.robots.from_file")
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
        factory = _of_python(path, function, registry) if path.suffix == ".py" else from_file(path, **_beside(path))
        name = factory("native").name
        if registry.get(name, factory) is not factory:
            raise ConfigError(f"robot file {path}: robot '{name}' exists already; rename the file, or set its name")
        _LOADED[key] = lambda mode: dataclasses.replace(factory(mode), reference=f"{path}{function}")
    return _LOADED[key]


def _beside(path: Path) -> dict[str, Any]:
    """Return what the YAML file beside a robot's says, if there is one."""
    *_, file = _files(path)
    plain = _READER.decoded(file.read_bytes(), "YAML", str(file)) if file != path else {}
    return vars(_READER.record(plain or {}, Facts, str(file)))


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
    alone = path.suffix != ".py" and not names_files(path)
    record = _Record(path.name if alone else f"{path}{function}", identity(robot))
    with writing(folder, "make room, or set run.out_dir"):
        folder.mkdir(parents=True)
        for file in _files(path) if alone else ():
            shutil.copyfile(file, folder / file.name)
    write_json(folder / "reference.json", dataclasses.asdict(record))


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
