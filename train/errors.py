"""Define what can go wrong for a user of `train` beside settings and files: each error is one clear line."""

from interactive_nav_common.errors import UserError


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged or belongs to something else."""


class PolicyError(UserError):
    """A policy of the user's that cannot be loaded, raises, or returns what are no actions."""


class DivergedError(UserError):
    """The learner's loss, parameters or statistics stopped being finite numbers."""
