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

_WHITE, _GREY, _BLUE = (0.9, 0.9, 0.9, 1.0), (0.356, 0.361, 0.376, 1.0), (0.086, 0.506, 0.767, 1.0)
_COLOURS: dict[str, tuple[float, ...]] = {
    **dict.fromkeys(("base", "head_pan", "wheel_left", "wheel_right"), _GREY),
    **dict.fromkeys(("torso_fixed", "head_tilt", "shoulder_lift", "elbow_flex", "wrist_flex"), _BLUE),
}
_JOINTS = "head_pan head_tilt shoulder_pan shoulder_lift upperarm_roll elbow_flex forearm_roll wrist_flex wrist_roll"
_FETCH = {name: f"{name}_link_collision" for name in _JOINTS.split()} | {
    "base": "base_link_collision",
    "torso_fixed": "torso_fixed_link",
    "torso": "torso_lift_link_collision",
    "wheel_left": "l_wheel_link_collision",
    "wheel_right": "r_wheel_link_collision",
    "gripper": "gripper_link",
}
"""Body -> its mesh."""


def _folder(package: str, name: str) -> Path:
    """Return the folder of an installed package."""
    found = importlib.util.find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise MissingPackage(
            f"this robot needs the files of {name}, which is not installed; pip install --no-deps {name}"
        )
    return Path(found.submodule_search_locations[0])


def fetch(control_mode: str) -> RobotSpec:
    """Fetch with the meshes of its maker for pictures, and for `rgb` with `image_geometry=meshes`."""
    folder = _folder("gymnasium_robotics", "gymnasium-robotics") / "envs" / "assets" / "stls" / "fetch"
    plain = robots.get_robot("fetch", control_mode)

    def add_to(world: mujoco.MjSpec) -> None:
        plain.add_to(world)
        for body, mesh in _FETCH.items():
            link = world.body(f"fetch_{body}")
            for geom in [g for g in link.geoms if g.group == VISUAL_GROUP]:
                world.delete(geom)
            name = f"fetch_{mesh}"
            world.add_mesh(
                name=name, file=str(folder / f"{mesh}.stl"), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            )
            shape = link.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=VISUAL_GROUP, mass=0.0)
            shape.contype = shape.conaffinity = 0
            shape.rgba = _COLOURS.get(body, _WHITE)

    return dataclasses.replace(plain, name="fetch_meshes", add_to=add_to)


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
    """Tiago, whose wheels are fixed and whose links have one inertia for all in robosuite's file."""
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
    """Spot on two hidden wheels: its legs hold still, and its feet slide. `from_file` has no gaits."""
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
