"""Parse a robot's URDF or MJCF file; a URDF is brought into the form that MuJoCo's reader expects."""

import math
import os
import re
import warnings
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from interactive_nav_common.errors import ConfigError, typed
from interactive_nav_common.untrusted.reading import check_named

_FLOATS = ("floating", "planar")
"""URDF joints that only say that the robot moves."""


def warn(path: Path, message: str) -> None:
    """Warn of a change to the user's file, which is named as the place."""
    warnings.warn_explicit(message, UserWarning, str(path), 0)


def _refused(path: Path, error: Exception) -> ConfigError:
    return ConfigError(f"robot file {path}: MuJoCo cannot read it ({str(error).splitlines()[0]})")


def compiled(spec: mujoco.MjSpec, path: Path) -> mujoco.MjModel:
    """Compile a copy of a parsed file."""
    try:
        return spec.copy().compile()
    except ValueError as error:
        raise _refused(path, error) from error


def read_file(path: Path, base_body: str = "") -> mujoco.MjSpec:
    """Parse an MJCF or URDF file."""
    if not path.is_file():
        raise ConfigError(f"robot file {path} does not exist, expected an MJCF or URDF file")
    data = path.read_bytes()
    try:
        root = ElementTree.fromstring(data)
        text = ElementTree.tostring(root, encoding="unicode")  # without comments and namespaces that nothing uses
    except ElementTree.ParseError as error:
        if b"<xacro:" not in data:
            raise _refused(path, error) from error
        root, text = ElementTree.Element("robot"), '/xacro"'
    if re.search(r'\$[({]|/xacro"', text):
        out = path.name.removesuffix(".xacro")
        out = out if out != path.name and out.endswith(".urdf") else f"{path.stem}_plain.urdf"
        again = typed("xacro", path.name, "-o", out)
        raise ConfigError(f"robot file {path}: is written in xacro, expected plain URDF; run xacro first: {again}")
    if root.tag not in ("robot", "mujoco"):
        raise ConfigError(
            f"robot file {path}: its root element is <{root.tag}>, expected <robot> (URDF) or <mujoco> (MJCF); "
            "give the URDF that an SDF model comes from (of a xacro file, run xacro first: "
            "xacro robot.urdf.xacro -o robot.urdf)"
        )
    try:
        if root.tag == "mujoco":
            check_named(path, ConfigError, "name meshes that are files")
            return mujoco.MjSpec.from_file(str(path))
        _simplify(root, path, base_body)
        [float(limit.get("velocity", 0)) for limit in root.iter("limit")]  # MuJoCo does not read it
        settings = root
        for tag in ("mujoco", "compiler"):
            found = settings.find(tag)
            settings = ElementTree.SubElement(settings, tag) if found is None else found
        settings.attrib |= {"strippath": "false", "discardvisual": "false"}
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise _refused(path, error) from error
    _weigh(spec)
    return spec


def _mesh_file(path: Path, name: str) -> Path:
    """Return the file that a URDF's mesh names; a package is the folder of the URDF or one above it."""
    name = re.sub(r"^\w+://", "", name)
    places = [folder / part for folder in path.parents[:3] for part in (name, name.partition("/")[2])]
    return next((place for place in places if os.path.isfile(place)), path.parent / name)


def names_files(path: Path) -> bool:
    """Return whether a robot's file refers to others: any in an MJCF, meshes that are there in a URDF."""
    text = path.read_bytes()
    meshes = re.findall(rb'filename="([^"]+)"', text)
    return b"file=" in text or any(os.path.isfile(_mesh_file(path, name.decode(errors="replace"))) for name in meshes)


def _simplify(root: ElementTree.Element, path: Path, base_body: str) -> None:
    """Drop what MuJoCo cannot read and the massless links above the base; refuse what it would misread."""
    for kind in ("link", "joint"):
        names = [element.get("name", "") for element in root.findall(kind)]
        for name in names:
            if not name or names.count(name) > 1:
                raise ConfigError(f"robot file {path}: {names.count(name)} {kind}s are named '{name}', expected one")
    links = {link.get("name", ""): link for link in root.findall("link")}
    for name, link in links.items():
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            if (mesh := shape.find("geometry/mesh")) is not None:
                file = _mesh_file(path, mesh.get("filename", ""))
                if file.suffix.lower() not in (".stl", ".obj") or not os.path.isfile(file):
                    if shape.tag == "collision":
                        raise ConfigError(
                            f"robot file {path}: link '{name}' collides as '{mesh.get('filename')}', expected an STL "
                            "or OBJ file that exists"
                        )
                    link.remove(shape)
                mesh.set("filename", str(file))
        for mass in link.findall("inertial/mass"):
            if not 0 <= float(mass.get("value", "nan")) < math.inf:
                raise ConfigError(f"robot file {path}: link '{name}' has mass {mass.get('value')}, expected kilograms")
    while True:
        ends = {
            joint: [getattr(joint.find(end), "attrib", {}).get("link", "") for end in ("parent", "child")]
            for joint in root.findall("joint")
        }
        children = [pair[1] for pair in ends.values()]
        top = next((name for name in links if name not in children), None)
        below = [joint for joint, pair in ends.items() if pair[0] == top]
        if top in (None, base_body) or len(below) != 1 or below[0].get("type") not in ("fixed", *_FLOATS):
            break
        if links[top].find("inertial") is not None or links[top].find("collision") is not None:
            break
        root.remove(links.pop(top))
        root.remove(below[0])
    for joint, (parent, child) in ends.items():
        if joint.get("type") in _FLOATS:
            raise ConfigError(
                f"robot file {path}: joint '{joint.get('name')}' from '{parent}' to '{child}' is "
                f"{joint.get('type')}, expected the robot below it: give base_body='{child}'"
            )


def _weigh(spec: mujoco.MjSpec) -> None:
    """Make the shapes of a URDF's links weightless where a link fixed to theirs declares the inertia of both."""

    def moving(body) -> str:
        while not body.joints and body.parent.name != "world":
            body = body.parent
        return body.name

    bodies = [body for body in spec.bodies if body.name != "world"]
    declared = {moving(body) for body in bodies if body.explicitinertial}
    for body in bodies:
        if not body.explicitinertial and moving(body) in declared:
            for geom in body.geoms:
                geom.mass = 0.0
