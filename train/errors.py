"""What can go wrong for a user of `train`: each error is one clear line (what, where, expected, remedy)."""


class TrainError(ValueError):
    """Base of the errors a user can cause or mend; the programs print it as one line and exit with 2."""


class ConfigError(TrainError):
    """A config file, an override or a combination of values that cannot be run."""


class RunFolderError(TrainError):
    """A run folder that cannot be written, read or continued."""


class CheckpointError(TrainError):
    """A checkpoint that is missing, damaged or belongs to something else."""


class DivergedError(TrainError):
    """The learner's loss, parameters or statistics stopped being finite numbers."""
