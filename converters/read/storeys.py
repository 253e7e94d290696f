"""A building with several floors in, one `RawScene` a floor out."""

import dataclasses

import numpy as np

from converters.geometry.faces import compacted
from converters.read.surfaces import long_faces, structure_labels
from converters.records.raw import RawScene

BELOW_FLOOR_M = 0.25
"""What lies this far below a floor still belongs to it (thresholds, waves); deeper is the storey below."""
STANDS_ABOVE_M = 0.5
"""An object's base may lie this far below its floor: annotations are off by centimetres, not by half a metre."""


def storey_of(z: np.ndarray, heights_m: tuple[float, ...], below_m: float = BELOW_FLOOR_M) -> np.ndarray:
    """Number of the storey that each height lies in; all below the lowest floor belongs to the lowest storey."""
    return np.searchsorted(np.array(heights_m[1:]) - below_m, z, side="right")


def label_storeys(vertices: np.ndarray, faces: np.ndarray, heights_m: tuple[float, ...]) -> np.ndarray:
    """(n,) labels by shape (`structure_labels`) of a building, each storey by its own floor."""
    of_vertex = storey_of(vertices[:, 2], heights_m)
    of_face = storey_of(vertices[faces, 2].mean(axis=1), heights_m)
    long = long_faces(vertices, faces)
    of_vertex[faces[long]] = of_face[long, None]
    labels = np.zeros(len(vertices), np.int64)
    for k, height in enumerate(heights_m):
        mine = of_vertex == k
        labels[mine] = structure_labels(vertices, faces[of_face == k], height)[mine]
    return labels


def split_storeys(raw: RawScene) -> tuple[RawScene, ...]:
    """One scene a floor, from the lowest up; a building with one floor as it is.

    A face belongs to the storey that its middle lies in, a long one to all that it reaches into, an object to the
    highest floor that its base is not half a metre below. Frames stay the building's own.
    """
    if len(raw.storeys) < 2:
        return (raw,)
    heights = tuple(s.height_m for s in raw.storeys)
    height = raw.scan.vertices[raw.scan.faces, 2]
    of_face = storey_of(height.mean(axis=1), heights)
    low, high = storey_of(height.min(axis=1), heights), storey_of(height.max(axis=1), heights)
    tall = long_faces(raw.scan.vertices, raw.scan.faces)
    base = [_base_m(raw, i) for i in range(len(raw.annotations))]
    of_object = storey_of(np.array(base), heights, STANDS_ABOVE_M)
    scenes = []
    for k, storey in enumerate(raw.storeys):
        mine = np.flatnonzero((of_face == k) | (tall & (low <= k) & (k <= high)))
        used, faces = np.unique(raw.scan.faces[mine], return_inverse=True)
        scan = dataclasses.replace(
            raw.scan,
            vertices=raw.scan.vertices[used],
            faces=faces.reshape(-1, 3),
            labels=raw.scan.labels[used],
            vertex_colours=None if raw.scan.vertex_colours is None else raw.scan.vertex_colours[used],
            corner_uv=None if raw.scan.corner_uv is None else raw.scan.corner_uv[mine],
        )
        annotations = tuple(a for a, of in zip(raw.annotations, of_object, strict=True) if of == k)
        scenes.append(
            dataclasses.replace(
                raw,
                name=f"{raw.name}_{k}",
                scan=scan,
                annotations=annotations,
                cads={a.cad_id: raw.cads[a.cad_id] for a in annotations},
                floor_height_m=storey.height_m,
                given_map=storey.given_map,
                storeys=(),
                lamps=tuple(p for p in raw.lamps if storey_of(p.at[2], heights, 0.0) == k),
                windows=tuple(w for w in raw.windows if storey_of(w.middle[2], heights, 0.0) == k),
                picture=tuple(p for v, f in raw.picture for p in _cut(v, f, heights, k)),
                warnings=(
                    *raw.warnings,
                    f"floor {k} of {len(heights)}, at {storey.height_m:g} m of the building's frame",
                ),
            )
        )
    return tuple(scenes)


def _cut(
    vertices: np.ndarray, faces: np.ndarray, heights_m: tuple[float, ...], number: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What of a drawn part belongs to a storey, as `split_storeys` has it."""
    z = vertices[faces, 2]
    low, of, high = (storey_of(some, heights_m) for some in (z.min(axis=1), z.mean(axis=1), z.max(axis=1)))
    mine = (of == number) | (long_faces(vertices, faces) & (low <= number) & (number <= high))
    return [compacted(vertices, faces[mine])] if mine.any() else []


def _base_m(raw: RawScene, index: int) -> float:
    annotation = raw.annotations[index]
    vertices = raw.cads[annotation.cad_id].vertices
    return float((vertices @ annotation.pose[2, :3]).min() + annotation.pose[2, 3])
