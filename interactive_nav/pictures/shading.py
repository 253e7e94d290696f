"""Colours of classes, and how pictures are lit."""

from __future__ import annotations

from typing import Any

import numpy as np

from interactive_nav.sensing.base import SKY_COLOUR
from scenes_mjcf.categories import SEGMENTATIONS

FLOOR_COLOUR = (0.56, 0.50, 0.43)
PALETTES = {
    classes: np.array([*masks.colours, FLOOR_COLOUR, SKY_COLOUR], np.float32)
    for classes, masks in SEGMENTATIONS.items()
}
"""The setting `segmentation_classes` -> colours by class id, then the floor's and the background's."""
_LIGHT_W = np.array([0.35, 0.25, 0.9], np.float32) / np.linalg.norm([0.35, 0.25, 0.9])


def lambert(base: Any, normal_w: Any, forward_w: Any, met: Any, xp: Any) -> Any:
    """Colours [..., 3] in [0, 1] lit by a sun and a lamp at the camera; u8; what is not `met` keeps its colour."""
    light_w = xp.broadcast_to(xp.asarray(_LIGHT_W), normal_w.shape)
    sun = xp.maximum((normal_w * light_w).sum(-1), 0.0)
    lamp = xp.maximum(-(normal_w * forward_w).sum(-1), 0.0)
    light = xp.where(met, xp.minimum(0.45 + 0.4 * sun + 0.25 * lamp, 1.0), 1.0)
    return xp.round(255.0 * base * light[..., None]).astype(xp.uint8)
