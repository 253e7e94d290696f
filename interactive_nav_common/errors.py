"""What a user can cause or mend: each error is one clear line (what, got, expected, remedy)."""


class UserError(ValueError):
    """Base of the errors that programs print as one line and exit with 2."""


class ConfigError(UserError):
    """A setting that does not exist, a value that it cannot have, or a combination that cannot be run."""


class FileError(UserError):
    """A file or folder that cannot be read, written or locked."""
