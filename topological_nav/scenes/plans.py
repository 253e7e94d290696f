"""Plans of the generated scenes: the rooms that each building was drawn with, by the scene's digest.

Drawn by `converters.generate.design_building` from `scenes_mjcf/recipes.yaml`; a test draws them again and compares.
"""

import json
from pathlib import Path

Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1 (m, world): the clear inside of a room."""

_PLANS = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
RECORDED: dict[str, tuple[Rectangle, ...]] = {
    plan["digest"]: tuple((x0, y0, x1, y1) for x0, y0, x1, y1 in plan["rooms"]) for plan in _PLANS.values()
}
