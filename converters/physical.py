"""Category and hulls in; mass, centre of mass, inertia and friction out."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh

from converters.objects import Hull


@dataclasses.dataclass(frozen=True)
class Material:
    """Physical properties of one category."""

    density_kg_m3: float
    """Of the *decomposed hulls*, which enclose air between legs and in padding: lower than the material's
    own."""
    mass_range_kg: tuple[float, float]
    """What the real thing weighs; density x volume is clipped to it (hull volume varies with the
    decomposition)."""
    friction: float
    """Sliding coefficient against the floor."""


# Masses: catalogue weights of household furniture (a wooden or swivel chair 4-8 kg, a two- or three-seat
# sofa 30-60 kg, a dining or meeting table 10-40 kg, a desk 15-45 kg, an interior door leaf 15-35 kg, a
# waste basket 0.5-2 kg). Densities: such a mass divided by the hull volume of typical models (a chair's
# hulls hold about 0.05 m3, a table's 0.045 m3, a sofa's 0.5 m3, a basket's 0.009 m3); a hollow-core door
# leaf is about 320 kg/m3, and its hulls are half as thick again as the leaf). Friction: wood and plastic
# on wood, carpet or linoleum lie between 0.3 and 0.6; a door touches no floor.
MATERIALS = {
    "chair": Material(115.0, (4.0, 8.0), 0.5),
    "sofa": Material(85.0, (30.0, 60.0), 0.6),
    "table": Material(400.0, (10.0, 40.0), 0.5),
    "desk": Material(330.0, (15.0, 45.0), 0.5),
    "door": Material(220.0, (12.0, 35.0), 0.4),
    "basket": Material(115.0, (0.5, 2.0), 0.4),
}


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


def physical_properties(category: str, hulls: tuple[Hull, ...]) -> Physical:
    """Mass = density x summed hull volume, clipped to the category's range; moments from the same hulls.

    Args:
        category: a key of `MATERIALS`.
        hulls: of one object, body frame, scaled, m.
    """
    material = MATERIALS[category]
    volumes, centres, inertias = [], [], []
    for hull in hulls:
        properties = trimesh.triangles.mass_properties(hull.vertices[hull.faces])
        volumes.append(abs(float(properties.volume)))
        centres.append(np.asarray(properties.center_mass, float))
        inertias.append(np.asarray(properties.inertia, float))  # about the hull's own centre, unit density
    volume = float(sum(volumes))
    com = np.average(centres, axis=0, weights=volumes)
    inertia = np.zeros((3, 3))
    for v, centre, own in zip(volumes, centres, inertias, strict=True):
        r = centre - com
        inertia += own + v * (r @ r * np.eye(3) - np.outer(r, r))  # parallel axes
    wanted = material.density_kg_m3 * volume
    mass = float(np.clip(wanted, *material.mass_range_kg))
    return Physical(mass, com, inertia * mass / volume, material.friction, volume, mass != wanted)
