"""Define the errors that a user can act on, and limits: of what a source may hold, and of a scene's gates."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

from PIL import Image

from interactive_nav_common.errors import UserError


class SceneRejected(UserError):
    """Report input that cannot become a scene (missing or broken file, no floor, unknown category, ...)."""


class StageFailed(RuntimeError):
    """Report a stage that broke on input that had passed the readers; the message names stage and object."""


CANNOT_WRITE = 74
"""Exit code of a worker whose result does not fit on the disk: no fault of the model's."""


EXTENT_M = 100.0  # longest side of a building, or of a floor plane
SAMPLES = 30_000_000  # points that are held at a time of a sampled surface
CLOUD = 5_000_000  # coloured points of a textured scan, from which on they stand further apart
PIXELS = 2 * 8192 * 8192  # of one image or height field, or of a joint texture, which is scaled down
FILES = 1_000  # MJCF files of a home: includes, and models that it attaches
PARTS = 20_000  # models or instances of a home
GEOMS = 100_000  # elements of an MJCF home, replicas and attached models counted
MOVABLES = 500  # pieces of furniture that stand on a home's floor
ENTRIES = 20_000  # files in a drawing's archive
UNPACKED = 1 << 30  # bytes of such an archive with all within it, unpacked
DRAWN = 3_000  # elements of a drawing: walls, rooms, pieces of furniture
NUMBERS = 10_000_000  # that a glTF file may ask for without giving them

Image.MAX_IMAGE_PIXELS = PIXELS // 2  # Pillow warns from here on, and refuses twice as many


def check_count(where: object, count: float, most: float, what: str, remedy: str = "split the source") -> None:
    """Refuse more of `what` than there may be, naming the file and the remedy."""
    if not count <= most:
        raise SceneRejected(f"{where}: has {count:,.0f} {what}, expected at most {most:,.0f}; {remedy}")


def check_image(path: Path) -> None:
    """Refuse a file whose header declares too large an image; what is no image passes."""
    try:
        with contextlib.suppress(OSError, ValueError, SyntaxError):
            Image.open(path).close()
    except Image.DecompressionBombError as error:
        raise SceneRejected(f"{path}: {error}; scale the image down") from error


@dataclasses.dataclass(frozen=True)
class Limit:
    """State what a gate demands."""

    unit: str
    least: float | None = None
    most: float | None = None
    meaning: str = ""


@dataclasses.dataclass(frozen=True)
class Gate:
    """Hold one gate's outcome."""

    name: str
    value: float
    passed: bool
    limit: Limit
    warnings: tuple[str, ...] = ()
    """Problems that the value does not show, whether the gate passed or not."""

    def as_dict(self) -> dict[str, Any]:
        """Return what scene.json says of it."""
        bound = {k: v for k, v in (("least", self.limit.least), ("most", self.limit.most)) if v is not None}
        return {"passed": self.passed, "value": round(self.value, 6), "limit": bound, "unit": self.limit.unit}
