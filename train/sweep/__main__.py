"""Run `python -m train.sweep`: train the runs of one YAML file and write rows of their evaluation."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from interactive_nav_common.commands import Flag, OnCluster, Repeated, option, parse, word
from interactive_nav_common.config import Bounds, Positive, settings_help
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.jobs.gpus import find_gpus
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.signals import stop_signals
from train.config_io import preset_names
from train.runs import STEP
from train.runs.run_folder import claim
from train.sweep import spec
from train.sweep.folder import SweepDisplay, SweepFolder, status_table, totals
from train.sweep.scheduler import PROGRAMS, STAGES, Machine, Programs, Scheduler
from train.sweep.spec import SweepConfig


class Sweep(OnCluster):
    """Train and evaluate every run of a sweep. The same command continues unfinished runs and skips finished ones."""

    sweep: Annotated[str, *word("NAME|PATH")]
    """Name of a sweep, or path of a YAML file."""
    status: Flag = False
    """Print the progress of every run and exit."""
    export: Annotated[Path | None, option(metavar="DIR")] = None
    """Copy rows, curves and the checkpoint of each cell's best run to this folder."""
    policy_step: Annotated[float, Bounds(0, 4, open=True)] = STEP
    """Rounding step of the exported weights in standard deviations, with --export."""
    resume: Flag = False
    """Only continue: refuse a sweep that was never started."""
    only: Annotated[Literal["train", "evaluate"] | None, option(metavar="train|evaluate")] = None
    """Only train runs, or only evaluate trained runs."""
    time_limit: Annotated[Positive | None, option(metavar="SECONDS")] = None
    """Stop all runs after this time in seconds; their checkpoints are kept."""
    where: Annotated[Repeated, option(metavar="KEY=VALUE[,VALUE]")] = ()
    """Only process runs with these settings, for example env.robot=fetch."""

    @classmethod
    def epilog(cls) -> str:
        return (
            f"sweeps: {', '.join(preset_names(spec.SWEEP_DIR))}\n\n"
            f"keys of the file (default):\n{settings_help(SweepConfig(), equals=': ')}\n\n"
            "exit codes: 0 all done (or in another sweep's hands), "
            "1 runs were given up or are not done, 2 the file is wrong, 3 stopped by the time limit, 128 + signal"
        )


@reports_errors("train.sweep")
def main(argv: Sequence[str] | None = None, programs: Programs = PROGRAMS) -> int:
    """Run a sweep; see `Outcome.exit_code`."""
    arguments = parse(Sweep, "python -m train.sweep", argv)
    console = SafeConsole()
    sweep = spec.select(spec.load_sweep(arguments.sweep), arguments.where)
    folder = SweepFolder(sweep)
    if arguments.status:
        states = [folder.state(run) for run in sweep.runs]
        console.print(status_table(states))
        console.print(totals(states))
        return 0
    if arguments.export:
        from train.sweep.export import export

        size, best = export(folder, arguments.export, arguments.policy_step)
        for name in best.values():
            console.print(f"checkpoint of {name}")
        console.print(f"{arguments.export}: {size / 2**20:.1f} MiB")
        return 0
    if arguments.resume and not (folder.root / "configs").is_dir():
        raise ConfigError(f"--resume: {folder.root} holds no sweep; leave --resume out to begin it")
    if arguments.only == "evaluate" and not any(folder.state(run).env_steps for run in sweep.runs):
        raise ConfigError(f"--only evaluate: no run of {folder.root} has trained a step; train first, without --only")
    claim(folder.root)
    folder.prepare()
    if arguments.launcher == "ray":
        from interactive_nav_common.jobs.on_ray import RayLauncher

        launcher = RayLauncher(arguments.ray_address or "auto")
    else:
        launcher = Machine(find_gpus(), sweep.config.launch.slots)
    stages = (arguments.only,) if arguments.only else STAGES
    with stop_signals(second_ends=False) as stops, SweepDisplay(console) as display:
        display.event(f"{folder.root}: {len(sweep.runs)} runs")
        scheduler = Scheduler(folder, launcher, display, stages, programs)
        outcome = scheduler.run(stops, arguments.time_limit)
    console.print(status_table(outcome.states))
    console.print(totals(outcome.states))
    if outcome.elsewhere:
        console.print(f"{outcome.elsewhere} runs were left to another sweep that works on them")
    if outcome.stopped_by or outcome.timed_out:
        console.print("the same command continues")
    return outcome.exit_code("trained" if arguments.only == "train" else "done")


if __name__ == "__main__":
    sys.exit(main())
