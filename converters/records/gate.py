"""A gate's limit and its outcome."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Limit:
    """What a gate demands."""

    unit: str
    least: float | None = None
    most: float | None = None
    meaning: str = ""


@dataclasses.dataclass(frozen=True)
class Gate:
    """One gate's outcome."""

    name: str
    value: float
    passed: bool
    limit: Limit
    warnings: tuple[str, ...] = ()
    """What the value does not tell, passed or not."""

    def as_dict(self) -> dict[str, Any]:
        """For scene.json."""
        bound = {k: v for k, v in (("least", self.limit.least), ("most", self.limit.most)) if v is not None}
        return {"passed": self.passed, "value": round(self.value, 6), "limit": bound, "unit": self.limit.unit}
