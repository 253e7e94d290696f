"""Hold what is drawn: coloured points of a scan, and meshes with their images."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class ColourCloud:
    """Coloured points of a surface."""

    points: np.ndarray
    """(n, 3) m."""
    normals: np.ndarray
    """(n, 3) unit, or zero where unknown."""
    colours: np.ndarray
    """(n, 3) float64, 0 to 255."""


@dataclasses.dataclass(frozen=True)
class TexturedMesh:
    """A mesh with at most one image."""

    vertices: np.ndarray
    """(n, 3) float64, m."""
    faces: np.ndarray
    """(m, 3) int64."""
    corner_uv: np.ndarray | None
    """(m, 3, 2) float64, origin at the lower left, or None without an image."""
    texture: np.ndarray | None
    """(h, w, 3) uint8, or None."""


@dataclasses.dataclass(frozen=True)
class VisualMesh:
    """A mesh with separately indexed texture coordinates."""

    vertices: np.ndarray
    """(n, 3) m."""
    faces: np.ndarray
    """(m, 3) into `vertices`."""
    uv: np.ndarray
    """(k, 2) in [0, 1], origin at the lower left."""
    uv_faces: np.ndarray
    """(m, 3) into `uv`."""
    image: np.ndarray
    """(h, w, 3) uint8, first row at the top."""
    exact: bool = False
    """The image is the source's, and is written as it is."""


def joined_clouds(*clouds: ColourCloud) -> ColourCloud:
    """Join clouds into one."""
    return ColourCloud(*(np.vstack([getattr(c, f.name) for c in clouds]) for f in dataclasses.fields(ColourCloud)))
