"""What can go wrong for a user of `topological_nav`: each error is one clear line (what, got, expected, remedy)."""


class TopologicalError(ValueError):
    """Base of the errors that a user can cause or mend; the programs print it as one line and exit with 2."""


class SettingsError(TopologicalError):
    """A setting that does not exist, or a value that it cannot have."""


class SpaceError(TopologicalError):
    """A scene without the free space that was asked for."""


class DatasetError(TopologicalError):
    """A dataset that is missing, incomplete, or made with other settings."""


class RunError(TopologicalError):
    """A run folder that is missing, damaged, or trained with other settings."""


class MapError(TopologicalError):
    """A topological map that is damaged, of another version, or of another scene."""
