"""Run `python -m train`: train as the command line says, write a run folder and return an exit code."""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from interactive_nav_common.commands import Command, Flag, Words, option, parse
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from train import config_io
from train.config import TrainConfig


class Train(Command):
    """Train a policy. The same command continues a run that was stopped or killed."""

    settings: Words = ()
    """Override settings, listed below."""
    config: Annotated[str | None, option(metavar="NAME|PATH")] = None
    """Preset to train, or path of a YAML file."""
    resume: Annotated[Path | None, option(metavar="RUN_DIR")] = None
    """Run folder to continue, with its own config."""
    robot: Annotated[str | None, option(metavar="NAME|FILE")] = None
    """Set env.robot: a name, a URDF or MJCF file, or path.py:function."""
    checkpoint: Annotated[str, option(metavar="best|last|STEPS")] = "last"
    """Checkpoint to continue from, with --resume."""
    print_config: Flag = False
    """Print the complete config as YAML, which --config can read, and exit."""

    @classmethod
    def epilog(cls) -> str:
        presets = ", ".join(config_io.preset_names())
        return f"presets: {presets}\n\nsettings (key=default):\n{config_io.help_text()}"

    def read_config(self) -> TrainConfig:
        """Return the config that the command line describes."""
        words = config_io.with_robot(self.settings, self.robot)
        if (self.config is None) == (self.resume is None):
            raise ConfigError("expected either --config or --resume (--help lists all)")
        if self.config:
            return config_io.load_config(self.config, words)
        assert self.resume is not None
        from train.runs.run_folder import RunFolder  # heavy

        config = RunFolder(self.resume).read_config()
        run = dataclasses.replace(config.run, out_dir=str(self.resume.parent), name=self.resume.resolve().name)
        return config_io.apply_overrides(dataclasses.replace(config, run=run), words)


@reports_errors("train")
def main(argv: Sequence[str] | None = None) -> int:
    """Train; return 0 when done, 2 on a user's error, 128 + signal when stopped by one (after saving)."""
    arguments = parse(Train, "python -m train", argv)
    config = arguments.read_config()
    if arguments.print_config:
        print(config_io.to_yaml(config), end="")
        return 0
    # Heavy: after the config has been checked.
    from train.runs.processes import one_for_each_gpu
    from train.runs.run import train_run
    from train.scoring.teacher import TaughtEnv

    teacher = config.clone.teacher
    built: Any = {"build_env": functools.partial(TaughtEnv, teacher)} if teacher else {}
    command = [sys.executable, "-m", "train", *(sys.argv[1:] if argv is None else argv)]
    with one_for_each_gpu(config.run.devices, command):
        _, _, stopped_by = train_run(config, SafeConsole(), resume_from=arguments.checkpoint, **built)
    return 128 + stopped_by if stopped_by else 0


if __name__ == "__main__":
    sys.exit(main())
