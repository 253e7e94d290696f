"""Run `python -m train.sweep`: train the runs of one YAML file and write rows of their evaluation."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from interactive_nav_common.config import refuse_unused, settings_help
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole
from interactive_nav_common.signals import stop_signals
from interactive_nav_common.words import program
from train.config_io import preset_names
from train.runs.checkpoint import STEP
from train.runs.run_folder import claim
from train.sweep import spec
from train.sweep.folder import SweepDisplay, SweepFolder, status_table, totals
from train.sweep.scheduler import PROGRAMS, STAGES, Machine, Programs, Scheduler, find_gpus
from train.sweep.spec import SweepConfig


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    epilog = (
        f"keys of the file (default):\n{settings_help(SweepConfig(), equals=': ')}\n\n"
        "exit codes: 0 all done (or in another sweep's hands), "
        "1 runs were given up or are not done, 2 the file is wrong, 3 stopped by the time limit, 128 + signal"
    )
    table, sweeps = Path(__file__).parents[1] / "words.yaml", ", ".join(preset_names(spec.SWEEP_DIR))
    return program(table, "sweep", epilog, sweeps=sweeps, step=STEP, stages=STAGES)


@reports_errors("train.sweep")
def main(argv: Sequence[str] | None = None, programs: Programs = PROGRAMS) -> int:
    """Run a sweep; see `Outcome.exit_code`."""
    arguments = parser().parse_args(argv)
    console = SafeConsole()
    chosen = [name for name in (arguments.sweep, arguments.config) if name]
    if len(chosen) != 1:
        raise ConfigError(f"expected one sweep, by name or path, got {len(chosen)}; see --help")
    if arguments.time_limit is not None and not arguments.time_limit > 0:
        raise ConfigError(f"--time-limit is {arguments.time_limit}, expected a positive number of seconds")
    if not 0 < arguments.policy_step <= 4:
        raise ConfigError(f"--policy-step is {arguments.policy_step:g}, expected above 0 and at most 4")
    if arguments.launcher != "ray":
        refuse_unused(arguments, "--ray-address", "without --launcher ray")
    if arguments.unfinished and arguments.only != "evaluate":
        raise ConfigError("--unfinished evaluates without training on; expected --only evaluate with it")
    sweep = spec.select(spec.load_sweep(chosen[0]), arguments.where, arguments.shard)
    folder = SweepFolder(sweep)
    if arguments.status:
        states = [folder.state(run) for run in sweep.runs]
        console.print(status_table(states))
        console.print(totals(states), highlight=False, soft_wrap=True)
        return 0
    if arguments.export:
        from train.sweep.export import export

        size, best = export(folder, Path(arguments.export), arguments.policy_step)
        for name in best.values():
            console.print(f"checkpoint of {name}", highlight=False)
        console.print(f"{arguments.export}: {size / 2**20:.1f} MiB", highlight=False, soft_wrap=True)
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
    try:
        with stop_signals(second_ends=False) as stops, SweepDisplay(console) as display:
            display.event(f"{folder.root}: {len(sweep.runs)} runs")
            outcome = Scheduler(folder, launcher, display, stages, arguments.redo, arguments.unfinished, programs).run(
                stops, arguments.time_limit
            )
    finally:
        launcher.close()
    console.print(status_table(outcome.states))
    console.print(totals(outcome.states), highlight=False, soft_wrap=True)
    if outcome.elsewhere:
        console.print(f"{outcome.elsewhere} runs were left to another sweep that works on them", highlight=False)
    if outcome.stopped_by or outcome.timed_out:
        console.print("the same command continues", highlight=False)
    return outcome.exit_code(
        "unfinished" if arguments.unfinished else "trained" if arguments.only == "train" else "done"
    )


if __name__ == "__main__":
    sys.exit(main())
