"""Read single contacts of the robot, for options that each body's net force cannot answer.

The original's code leaves out friction and wheels, and could sum the contacts' norms (reference benchmark, section 11,
rows 4, 6 and 7). MuJoCo's contact sensors cover a whole robot, so the forces of its rolling parts are subtracted: those
are `rolling_bodies` and casters, frictionless geoms (condim 1) of other bodies.
"""

from typing import Any

import mujoco
import numpy as np

from interactive_nav.robots import RobotSpec

SLOTS = 32
"""Contacts listed between the robot, or one of its wheels, and one body; more than a robot's few boxes make."""
_FIELDS = 7
"""whether there is one (1), force in the contact's frame (3), normal in the world frame (3)."""
_DATA = sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name}")) for name in ("FOUND", "FORCE", "NORMAL"))
_ALL = "contacts_of_robot"
_ROLLING = "contacts_of_rolling"


def add_sensor(
    spec: mujoco.MjSpec, name: str, objtype: mujoco.mjtObj, objname: str, body: str, numbers: tuple[int, int, int]
) -> None:
    """Add a contact sensor of a part of the robot against a body; `numbers` are its data, reduction and slots."""
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=objtype,
        objname=objname,
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname=body,
        intprm=list(numbers),
    )


def add_contact_sensors(spec: mujoco.MjSpec, robot: RobotSpec, bodies: list[str]) -> None:
    """List the robot's and its rolling parts' contacts with each of the bodies."""
    geoms, data = spec.body(robot.base_body).find_all("geom"), (_DATA, 0, SLOTS)
    casters = [g.name for g in geoms if g.condim == 1 and g.parent.name not in robot.rolling_bodies]
    rolling = [(mujoco.mjtObj.mjOBJ_BODY, wheel) for wheel in robot.rolling_bodies]
    rolling += [(mujoco.mjtObj.mjOBJ_GEOM, caster) for caster in casters]
    for i, body in enumerate(bodies):
        add_sensor(spec, f"{_ALL}_{i}", mujoco.mjtObj.mjOBJ_XBODY, robot.base_body, body, data)
        for kind, part in rolling:
            add_sensor(spec, f"{_ROLLING}_{i}_{part}", kind, part, body, data)


def rolling_geoms(model: mujoco.MjModel, robot: RobotSpec, robot_bodies: np.ndarray) -> np.ndarray:
    """Return [ngeom] bool: parts of the robot that roll, as the sensors take them."""
    wheels = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in robot.rolling_bodies]
    of_robot = np.isin(model.geom_bodyid, robot_bodies)
    return of_robot & (np.isin(model.geom_bodyid, wheels) | (model.geom_condim == 1))


def sensor_addresses(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return addresses in sensordata of the robot's lists [a, SLOTS, 7] and of its rolling parts' [b, SLOTS, 7]."""
    names = [(model.sensor(i).name, int(model.sensor_adr[i])) for i in range(model.nsensor)]

    def of(prefix: str) -> np.ndarray:
        starts = np.array([adr for name, adr in names if name.startswith(prefix)], np.int64)
        return starts[:, None, None] + np.arange(SLOTS * _FIELDS).reshape(SLOTS, _FIELDS)

    return of(_ALL), of(_ROLLING)


def part_of_contacts(force_c: Any, normal_w: Any, part: str, xp: Any) -> tuple[Any, Any, Any]:
    """Return the vector sum of contacts' normal forces [..., 3], and the sums of the chosen part's norms and of the
    normal forces' norms [...]. `force_c` [..., c, 3], N, is in the contacts' frames, normal first, 0 where there is no
    contact; `normal_w` is [..., c, 3]."""
    pressure = force_c[..., 0]
    norm = xp.sqrt((force_c**2).sum(-1)) if part == "full" else abs(pressure)
    return (pressure[..., None] * normal_w).sum(-2), norm.sum(-1), abs(pressure).sum(-1)


def from_sensors(data: Any, addresses: tuple[np.ndarray, np.ndarray], part: str, xp: Any) -> tuple[Any, Any, Any]:
    """Return `part_of_contacts` of a record of sensordata [..., nsensordata]: over all listed contacts, without the
    rolling parts' in the first and third, and in the second too where `part` is `normal`."""
    sums = []
    for where in addresses:
        listed = data[..., where.reshape(-1, _FIELDS)]
        is_contact = listed[..., :1] > 0
        sums.append(part_of_contacts(xp.where(is_contact, listed[..., 1:4], 0.0), listed[..., 4:7], part, xp))
    (vector, norm, touch), (rolling_vector, rolling_norm, rolling_touch) = sums
    norm = norm - rolling_norm if part == "normal" else norm
    # Differences of equal sums leave rounding behind.
    return vector - rolling_vector, xp.maximum(norm, 0.0), xp.maximum(touch - rolling_touch, 0.0)
