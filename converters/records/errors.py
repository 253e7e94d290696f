"""Errors that a user of the converter can act on: one line with what, where, expected, remedy."""

from interactive_nav_common.errors import UserError


class SceneRejected(UserError):
    """The input cannot become a scene (missing or broken file, no floor, unknown category, ...)."""


class StageFailed(RuntimeError):
    """A stage broke on input that had passed the readers; the message names stage and object."""


CANNOT_WRITE = 74
"""Exit code of a worker whose result does not fit on the disk: no fault of the model's."""
