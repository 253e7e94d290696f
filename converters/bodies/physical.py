"""Category and hulls in; mass, centre of mass, inertia and friction out."""

from __future__ import annotations

import dataclasses

import numpy as np
import trimesh

from converters.geometry.boxes import Hull


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


# Masses. Averages of the reuse sector (Merseyside Recycling and Waste Authority with the Furniture Re-use Network,
# www.merseysidewda.gov.uk/average-weights): dining chair 7 kg, office chair 12, small or coffee table 14, medium 23,
# large 29, small desk 20, large 27, sofa of two seats 37, of three 42. A solid-core interior leaf of 0.91 x 2.03 m
# weighs 18 to 32 kg (engineerfix.com/how-much-does-a-solid-core-door-weigh), a hollow-core one about half. The ranges
# lie around these; a chair's is that of the dining chair, 4 to 8 kg. Waste baskets: own estimate, plastic to steel.
# Densities: the middle of the range divided by the hull volume of typical models (a chair's hulls hold about 0.05 m3,
# a table's 0.045 m3, a sofa's 0.5 m3, a basket's 0.009 m3; door hulls are half as thick again as the leaf).
# Friction: wood and plastic on wood, carpet or linoleum lie between 0.3 and 0.6; a door touches no floor.
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
