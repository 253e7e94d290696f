"""Train and evaluate every run with a launcher, give it up with a reason, or stop it where it can go on."""

import contextlib
import dataclasses
import functools
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from interactive_nav_common.config import replace
from interactive_nav_common.jobs.gpus import Gpu
from interactive_nav_common.jobs.processes import LOCKED, LOST, Job, Launcher, Share, run_jobs
from train.sweep.folder import RunState, SweepDisplay, SweepFolder, log_tail, words_of_evaluation
from train.sweep.spec import LaunchConfig

STAGES = ("train", "evaluate")
POLL_S = 0.5
EVALUATED_TOGETHER = 8
"""Runs of one environment that a process evaluates one after the other: it compiles once."""
LAST_START_S = 60.0
"""So shortly before the time limit (or its last tenth, if that is less) nothing is started."""
ELSEWHERE_S = 10.0
"""Between two looks whether a run that somebody else works on is free."""
REFUSED = 2
"""Exit code of errors that another try cannot mend."""
OUT_OF_MEMORY = ("resource_exhausted", "out of memory", "cuda_error_out_of_memory", "memory allocation failed")


Programs = Mapping[str, tuple[str, ...]]
PROGRAMS: Programs = {"train": ("-m", "train"), "evaluate": ("-m", "train.evaluate")}
"""Stage -> the words of its `python`; tests give others."""
USABLE = 0.95
"""Part of a GPU's memory that runs may fill: the driver takes some."""


class Machine(Launcher):
    """Processes on this machine, each with its share of a GPU, or whole GPUs, or of the cores."""

    def __init__(self, gpus: list[Gpu], slots: int):
        super().__init__(slots)
        self._gpus = gpus

    def take(self, job: "RunJob") -> Share | None:
        """Return a share of the emptiest GPU, whole GPUs for a job of several, or a share of the cores without GPUs."""
        if not self._gpus:
            return super().take(job)
        taken = [share for *_, share in self.running]
        free = {g: 1.0 - sum(part for names, part in taken if g.name in (names or "").split(",")) for g in self._gpus}
        if job.gpus > 1:
            # A run that needs more than there are gets all, and says itself what is missing.
            idle, wanted = [g.name for g in free if free[g] > 1 - 1e-9], min(int(job.gpus), len(free))
            return (",".join(idle[:wanted]), 1.0) if len(idle) >= wanted else None
        gpu, runs = max(free, key=lambda g: free[g]), job.launch.runs_per_gpu
        if job.launch.gpu_memory_gb:
            runs = max(1, min(runs, int(USABLE * gpu.memory_gb / job.launch.gpu_memory_gb)))
        part = min(1.0, job.factor * (1.0 / runs))
        return (gpu.name, part) if part <= free[gpu] + 1e-9 else None


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunJob(Job):
    """One program to run for one or several runs."""

    kind: str
    """train or evaluate."""
    runs: tuple[str, ...]
    launch: LaunchConfig
    factor: float = 1.0
    """Times the usual share of a GPU."""

    def env_on(self, gpu: str | None, part: float) -> Mapping[str, str]:
        """Return environment variables that keep it within its part of a GPU or of the cores."""
        if gpu is None:
            cores = max(1, int((os.cpu_count() or 1) * part))
            return {"OMP_NUM_THREADS": str(cores)} if part < 1.0 else {}
        return {
            "CUDA_DEVICE_ORDER": "PCI_BUS_ID",  # nvidia-smi's order
            "CUDA_VISIBLE_DEVICES": gpu,
            "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{USABLE * min(part, 1.0) * self.launch.jax_memory_share:.3f}",
        }


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a sweep's command ended."""

    states: tuple[RunState, ...]
    stopped_by: int | None
    """The signal, if one did."""
    timed_out: bool
    elsewhere: int
    """Runs left to somebody else who works on them."""

    def exit_code(self, done: str) -> int:
        """Return 0: every run is `done` or worked on elsewhere; 1: not; 3: stopped by the time limit; 128 + signal."""
        if self.stopped_by:
            return 128 + self.stopped_by
        left = [s for s in self.states if s.state not in ("done", done)]
        if any(s.reason for s in left):
            return 1
        if self.timed_out:
            return 3 if left else 0
        return 1 if any(s.state != "running" for s in left) else 0


@dataclasses.dataclass(eq=False)
class Scheduler:
    """Decide what runs next: training before evaluation, what failed once more, nothing past the time limit."""

    folder: SweepFolder
    launcher: Launcher
    display: SweepDisplay
    stages: Sequence[str] = STAGES
    programs: Programs = dataclasses.field(default_factory=lambda: PROGRAMS)
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._runs = {run.name: run for run in self.folder.sweep.runs}
        self._attempts: dict[tuple[str, str], int] = {}
        self._factor: dict[tuple[str, str], float] = {}
        self._given_up: set[tuple[str, str]] = set()
        self._alone: set[str] = set()
        self._not_before: dict[str, float] = {}
        self._outcome = Outcome((), None, False, 0)
        self._kill_at = math.inf
        """Finite once what runs was requested to end; -inf once it was killed."""

    def run(self, stops: list[int], time_limit_s: float | None = None, poll_s: float = POLL_S) -> Outcome:
        """Work until nothing is left, the time is over, or a signal requests a stop; a second signal does not wait.

        After the time limit, if any, all runs stop with a checkpoint.
        """
        ready = functools.partial(self._ready, stops, math.inf if time_limit_s is None else time_limit_s, self.clock())
        grace_s = self.folder.sweep.config.launch.grace_s
        with contextlib.closing(run_jobs(self.launcher, ready, grace_s, poll_s)) as ended:
            for job, code in ended:
                self._over(job, code)
        return self._outcome

    @property
    def _busy(self) -> dict[str, str]:
        """Return the runs that are worked on, and how."""
        running = self.launcher.running
        return {name: f"{job.kind}, {self.launcher.where(share)}" for job, _, share in running for name in job.runs}

    def _ready(self, stops: list[int], limit_s: float, began: float) -> Iterator[RunJob] | None:
        """Return the jobs that may start now, None if no more will come; end what runs where that is due."""
        now, busy = self.clock(), self._busy
        timed_out = self._outcome.timed_out or now - began >= limit_s
        if (stops or timed_out) and self._kill_at == math.inf:
            self._kill_at = now + self.folder.sweep.config.launch.grace_s
            if busy:
                why = f"time limit of {limit_s:.0f} s" if timed_out else signal.Signals(stops[0]).name
                self.display.event(f"{why}: {len(busy)} run(s) write their checkpoints (a second Ctrl-C does not wait)")
            self.launcher.send(signal.SIGTERM)
        if busy and self._kill_at > -math.inf and (len(stops) > 1 or now > self._kill_at):
            self._kill_at = -math.inf
            self.display.event("not waiting any longer: what they did since the last checkpoint is lost", "red")
            self.launcher.send(signal.SIGKILL)
        states = [self.folder.state(run) for run in self._runs.values()]
        self.display.update(states, busy)
        needed = {s.name for stage in STAGES for s in states if self._needs(stage, s)}
        elsewhere = {s.name for s in states if s.state == "running" and s.name in self._not_before}
        stopping = self._kill_at < math.inf
        left_to_others = 0 if stopping else len(elsewhere & needed)
        self._outcome = Outcome(tuple(states), stops[0] if stops else None, timed_out, left_to_others)
        if stopping or (not busy and elsewhere >= needed):
            return None
        late = limit_s - (now - began) < min(LAST_START_S, 0.1 * limit_s)
        return iter(()) if late else self._jobs(states)

    def _needs(self, stage: str, state: RunState) -> bool:
        """Return whether a stage is to be run for a run as far as it is."""
        if stage not in self.stages or state.name in self._busy or (stage, state.name) in self._given_up:
            return False
        if stage == "train":
            return not state.over
        return state.over and not self.folder.evaluated(self._runs[state.name])

    def _jobs(self, states: list[RunState]) -> Iterator[RunJob]:
        """Yield jobs for runs that nobody else works on, as far as is visible: training, first of runs that have begun,
        then evaluation. A job that has started is noted when the next one is drawn."""
        for kind in STAGES:
            now = self.clock()
            free = [s for s in states if self._needs(kind, s) and self._not_before.get(s.name, 0.0) <= now]
            begun_first = [[s.name] for s in sorted(free, key=lambda s: s.env_steps == 0)]
            for names in begun_first if kind == "train" else self._groups([s.name for s in free]):
                job = self._job(kind, names)
                yield job
                for name in names:
                    self._not_before.pop(name, None)
                    self.folder.try_again(name)
                where = self._busy[names[0]].removeprefix(f"{kind}, ")
                self.display.event(f"{job.name}: started ({where}), log {job.log}")

    def _groups(self, names: list[str]) -> list[list[str]]:
        """Group the runs to evaluate by one process each: those of one environment (k_int is in no score)."""
        kinds: dict[Any, list[str]] = {}
        for name in names:
            env = replace(self._runs[name].config.env, k_int=0.0)
            kinds.setdefault(name if name in self._alone else env, []).append(name)
        size = EVALUATED_TOGETHER
        return [group[i : i + size] for group in kinds.values() for i in range(0, len(group), size)]

    def _job(self, kind: str, names: list[str]) -> RunJob:
        run, others, program = self._runs[names[0]], len(names) - 1, self.programs[kind]
        devices = run.config.run.devices if kind == "train" else 1
        launch, factor = run.launch, max(self._factor.get((kind, name), 1.0) for name in names)
        if kind == "evaluate":
            command = words_of_evaluation(self.folder, names, program)
        else:
            command = [sys.executable, *program, "--config", str(self.folder.config(run.name))]
            if launch.slots > 1 and not run.config.env.threads:
                command += [f"env.threads={max(1, (os.cpu_count() or 1) // launch.slots)}"]
        return RunJob(
            name=f"{kind} {run.name}" + (f" and {others} more" if others else ""),
            kind=kind,
            runs=tuple(names),
            command=tuple(command),
            log=self.folder.log(run.name),
            locks=tuple(self.folder.lock(name) for name in names),
            launch=launch,
            factor=factor,
            cpus=launch.cpus_per_run,
            gpus=float(devices) if devices > 1 else min(1.0, factor / launch.runs_per_gpu),
        )

    def _over(self, job: RunJob, code: int) -> None:
        if code == LOCKED:
            held = [name for name in job.runs if self.folder.state(self._runs[name]).state == "running"]
            for name in held or job.runs:  # the others go on without them
                self._not_before[name] = self.clock() + ELSEWHERE_S
            self.display.event(f"{job.name}: somebody else works on it, looking again later", "yellow")
            return
        if job.kind == "evaluate":
            left = [name for name in job.runs if not self.folder.evaluated(self._runs[name])]
            for name in set(job.runs) - set(left):
                self.folder.drop_old_rows(self._runs[name])
        else:
            left = [name for name in job.runs if not self.folder.state(self._runs[name]).over]
        if not left:
            self.display.event(f"{job.name}: done", "green")
        elif self._kill_at < math.inf and code not in (1, REFUSED):
            self.display.event(f"{job.name}: stopped")
        elif len(job.runs) > 1:
            # Which of them is to blame shows when each has a separate process.
            self._alone.update(left)
            self.display.event(f"{job.name}: {_how(code)}; {len(left)} left, now one by one", "yellow")
        else:
            self._failed(job, code)

    def _failed(self, job: RunJob, code: int) -> None:
        (name,) = job.runs
        key = (job.kind, name)
        tail = log_tail(job.log, 40)
        shown = tail[-6:] or ["(nothing was printed)"]
        reason = f"{job.kind}: {_how(code)}: {shown[-1][:300]}"
        attempts = self._attempts[key] = self._attempts.get(key, 0) + 1
        over = code == REFUSED or attempts > job.launch.retries
        if over:
            self._given_up.add(key)
            self.folder.give_up(name, reason, attempts)
            what = "another try cannot mend it" if code == REFUSED else f"given up after {attempts} tries"
        else:
            hungry = any(word in line.lower() for line in tail for word in OUT_OF_MEMORY)
            self._factor[key] = job.factor * 2.0 if hungry else job.factor
            more = " with twice the memory" if hungry else ""
            what = f"tried again{more} ({attempts} of {job.launch.retries})"
        self.display.event(f"{job.name}: {_how(code)}, {what}; the end of {job.log}:", "red" if over else "yellow")
        for line in shown:
            self.display.event(f"    {line}")


def _how(code: int) -> str:
    if code == LOST:
        return "the node or its worker was lost"
    if not code:
        return "ended, but what it should have written is not there"
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"
