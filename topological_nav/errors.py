"""What can go wrong for a user of `topological_nav`: each error is one clear line (what, got, expected, remedy)."""

from interactive_nav_common.errors import UserError


class SpaceError(UserError):
    """A scene without the free space that was asked for."""


class DatasetError(UserError):
    """A dataset that is missing, incomplete, or made with other settings."""


class RunError(UserError):
    """A run folder that is missing, damaged, or trained with other settings."""


class MapError(UserError):
    """A topological map that is damaged, of another version, or of another scene."""
