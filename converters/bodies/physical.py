"""Category and hulls in; mass, centre of mass, inertia and friction out."""

import dataclasses

import numpy as np
import trimesh

from converters.geometry.boxes import Hull
from scenes_mjcf.categories import TABLE

MATERIALS = {category.name: category.material for category in TABLE if category.material is not None}


@dataclasses.dataclass(frozen=True)
class Physical:
    """Rigid-body properties in the body frame."""

    mass_kg: float
    com_b: np.ndarray
    """(3,) m."""
    inertia_b: np.ndarray
    """(3, 3) kg m2 about the centre of mass, along the body's axes."""
    friction: float
    volume_m3: float
    clipped: bool
    """True when density x volume fell outside the category's range."""


def mass_moments(hulls: tuple[Hull, ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """Summed volume, m3, centre of mass (3,), m, and inertia (3, 3) about it at unit density, of convex hulls."""
    volumes, centres, inertias = [], [], []
    for hull in hulls:
        properties = trimesh.triangles.mass_properties(hull.vertices[hull.faces])
        volumes.append(abs(float(properties.volume)))
        centres.append(np.asarray(properties.center_mass, float))
        inertias.append(np.asarray(properties.inertia, float))  # about the hull's own centre, unit density
    com = np.average(centres, axis=0, weights=volumes)
    inertia = np.zeros((3, 3))
    for v, centre, own in zip(volumes, centres, inertias, strict=True):
        r = centre - com
        inertia += own + v * (r @ r * np.eye(3) - np.outer(r, r))  # parallel axes
    return float(sum(volumes)), com, inertia


def physical_properties(
    category: str, hulls: tuple[Hull, ...], mass_kg: float | None = None, friction: float | None = None
) -> Physical:
    """Return mass, moments (body frame, m, kg) and friction; moments scale with the mass.

    The mass is density x summed hull volume, clipped to the category's range, unless the source gives one.
    """
    material = MATERIALS[category]
    volume, com, inertia = mass_moments(hulls)
    wanted = material.density_kg_m3 * volume
    usual = float(np.clip(wanted, *material.mass_range_kg))
    mass = usual if mass_kg is None else mass_kg
    friction = material.friction if friction is None else friction
    return Physical(
        mass, com, inertia * usual / volume * (mass / usual), friction, volume, mass_kg is None and usual != wanted
    )
