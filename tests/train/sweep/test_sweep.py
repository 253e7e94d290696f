"""Sweeps with quick programs in place of training: what runs, what is skipped, tried again, given up, stopped."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import yaml
from rich.console import Console

from interactive_nav_common.files import is_locked, take_lock
from interactive_nav_common.jobs import processes as jobs
from interactive_nav_common.jobs.gpus import Gpu, find_gpus, parse_gpus
from train.sweep import spec
from train.sweep.__main__ import main
from train.sweep.folder import RunState, SweepDisplay, SweepFolder, last_line, totals
from train.sweep.scheduler import Machine, Outcome, RunJob, Scheduler
from train.sweep.spec import LaunchConfig

FAKE = {stage: ("-m", "tests.train.sweep.fake", stage) for stage in ("train", "evaluate")}
ROOT = Path(__file__).parents[3]


def write_sweep(folder: Path, steps: int = 50, seeds: int = 2, **parts: object) -> Path:
    plain = {
        "out_dir": str(folder),
        "preset": "turtlebot_ppo",
        "grid": {"env.k_int": [0.0, 1.0], "run.seed": list(range(seeds))},
        "settings": {"run": {"num_timesteps": steps}},
        "evaluate": {"scenes": ["scenes_mjcf/alder", "scenes_mjcf/rowan"]},
        "launch": {"slots": 2, "retries": 1, "grace_s": 20.0},
    } | parts
    path = folder / "small.yaml"
    path.write_text(yaml.safe_dump(plain))
    return path


def sweep(path: Path, machine: Machine | None = None, limit_s: float | None = None, **keywords: object):
    """(outcome, what was printed, folder) of one command."""
    console = Console(file=io.StringIO(), width=400)
    folder = SweepFolder(spec.load_sweep(str(path)))
    folder.prepare()
    launcher = machine or Machine([], 2)
    with SweepDisplay(console) as display:
        scheduler = Scheduler(folder, launcher, display, programs=FAKE, **keywords)  # type: ignore[arg-type]
        outcome = scheduler.run([], limit_s, poll_s=0.05)
    return outcome, console.file.getvalue(), folder  # type: ignore[attr-defined]


def set_fates(folder: Path, fates: dict[str, list[str]]) -> None:
    """What the programs of `fake` do in each try."""
    (folder / "fates.json").write_text(json.dumps(fates))


def tries(folder: SweepFolder) -> dict[str, int]:
    return {
        run.name: len(path.read_text().splitlines()) if (path := folder.runs / run.name / "tries").is_file() else 0
        for run in folder.sweep.runs
    }


@pytest.fixture(autouse=True)
def fake_on_path(monkeypatch):
    monkeypatch.chdir(ROOT)


def test_a_sweep_trains_evaluates_and_is_not_done_twice(tmp_path):
    path = write_sweep(tmp_path)
    outcome, printed, folder = sweep(path)
    assert outcome.exit_code("done") == 0 and {s.state for s in outcome.states} == {"done"}
    assert [s.env_steps for s in outcome.states] == [50] * 4
    assert set(tries(folder).values()) == {1}
    assert len(list(folder.rows.glob("*.parquet"))) == 4
    assert "train k_int0-seed0: started (cpu)" in printed and "4 runs: 4 done" in totals(outcome.states)
    before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*") if p.is_file() and "configs" not in p.parts}
    again, printed, _ = sweep(path)
    assert again.exit_code("done") == 0 and "started" not in printed
    after = {p: p.stat().st_mtime_ns for p in before}
    assert before == after
    # More steps are wanted: the same runs go on, and are evaluated anew, their old rows gone.
    outcome, _, folder = sweep(write_sweep(tmp_path, steps=80))
    assert [s.env_steps for s in outcome.states] == [80] * 4 and {s.state for s in outcome.states} == {"done"}
    assert len(list(folder.rows.glob("*.parquet"))) == 4
    assert set(tries(folder).values()) == {2}
    # Another question to them: evaluated anew, not trained.
    more = {"scenes": ["scenes_mjcf/alder", "scenes_mjcf/rowan"], "episodes": 7}
    outcome, _, folder = sweep(write_sweep(tmp_path, steps=80, evaluate=more))
    assert {s.state for s in outcome.states} == {"done"} and set(tries(folder).values()) == {2}
    assert len(list(folder.rows.glob("*.parquet"))) == 4


def test_stages_can_be_run_and_repeated_alone(tmp_path):
    path = write_sweep(tmp_path)
    outcome, _, folder = sweep(path, stages=("train",))
    assert {s.state for s in outcome.states} == {"trained"} and not list(folder.rows.glob("*"))
    assert outcome.exit_code("trained") == 0
    outcome, printed, folder = sweep(path, stages=("evaluate",))
    assert {s.state for s in outcome.states} == {"done"} and printed.count("started") == 1  # k_int is in no score
    written = {p: p.stat().st_mtime_ns for p in folder.rows.iterdir()}
    assert len(written) == 4
    sweep(path, stages=("evaluate",))
    assert {p: p.stat().st_mtime_ns for p in folder.rows.iterdir()} == written
    (again,) = list(folder.rows.glob("k_int0-seed1-*.parquet"))
    again.unlink()
    sweep(path, stages=("evaluate",))
    assert [p for p in written if p.stat().st_mtime_ns > written[p]] == [again]


def test_how_far_a_run_is_is_told_while_another_sweep_tries_it_again(tmp_path):
    folder = SweepFolder(spec.load_sweep(str(write_sweep(tmp_path))))
    folder.prepare()
    run, over = folder.sweep.runs[0], threading.Event()

    def other_sweep() -> None:
        while not over.is_set():
            folder.give_up(run.name, "train: ended with exit code 1", 3)
            time.sleep(1e-4)
            folder.try_again(run.name)

    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(other_sweep)
        try:
            told, until = set(), time.monotonic() + 1.0
            while time.monotonic() < until or len(told) < 2:
                state = folder.state(run)
                told.add((state.state, state.reason))
        finally:
            over.set()
        other.result()
    assert told == {("waiting", ""), ("failed", "train: ended with exit code 1")}


def test_a_truncated_reason_is_told_with_the_status(tmp_path, capsys):
    path = write_sweep(tmp_path)
    folder = SweepFolder(spec.load_sweep(str(path)))
    folder.prepare()
    (folder.root / "failed" / f"{folder.sweep.runs[0].name}.json").write_text('{"reason": "tr')
    assert main([str(path), "--status"]) == 0
    state = folder.state(folder.sweep.runs[0])
    assert state.state == "failed" and "not readable as JSON" in state.reason


def test_there_is_nothing_to_evaluate_of_a_sweep_that_was_never_trained(tmp_path, capsys):
    path = write_sweep(tmp_path)
    assert main([str(path), "--only", "evaluate"], FAKE) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train.sweep: --only evaluate: no run of ") and "has trained a step; train first" in line
    assert not (tmp_path / "small").exists()


def test_what_a_killed_evaluation_left_goes_at_the_next_start(tmp_path):
    """Paths are written before rows: killed between, or while writing, it leaves them without."""
    path = write_sweep(tmp_path)
    _, _, folder = sweep(path)
    paths = folder.rows / "_paths"
    paths.mkdir()
    done = paths / f"{next(folder.rows.glob('k_int0-seed0-*.parquet')).stem}.npz"
    begun = [paths / ".partial-01234567-k_int0-seed0-89abcdef.npz", folder.rows / ".partial-01234567-x.parquet"]
    lonely, busy = paths / "k_int0-seed0-89abcdef.npz", paths / "k_int1-seed0-89abcdef.npz"
    others = paths / "k_int0-seed00-89abcdef.npz"
    for file in (done, *begun, lonely, busy, others):
        file.touch()
        os.utime(file, (0, 0))
    held = take_lock(folder.lock("k_int1-seed0"))
    assert held is not None
    folder.prepare()
    os.close(held)
    assert sorted(paths.iterdir()) == sorted([done, busy, others]) and len(list(folder.rows.glob("*.parquet"))) == 4


def test_failures_stay_with_their_run_and_are_tried_again_so_many_times(tmp_path, monkeypatch):
    fates = {
        "k_int0-seed0": ["crash"],
        "k_int0-seed1": ["crash", "crash", "crash"],
        "k_int1-seed0": ["refuse", "refuse"],
        "k_int1-seed1": ["", "", "no-evaluation"],
    }
    set_fates(tmp_path, fates)
    outcome, printed, folder = sweep(write_sweep(tmp_path))
    assert outcome.exit_code("done") == 1
    states = {s.name: s for s in outcome.states}
    assert states["k_int0-seed0"].state == "done"
    assert states["k_int0-seed1"].state == states["k_int1-seed0"].state == "failed"
    assert states["k_int1-seed1"].state == "trained"  # its evaluation failed, alone
    assert tries(folder) == {"k_int0-seed0": 2, "k_int0-seed1": 2, "k_int1-seed0": 1, "k_int1-seed1": 1}
    assert states["k_int0-seed1"].reason == "train: ended with exit code 1: IndexError: the toy broke"
    assert "env.scenes is empty" in states["k_int1-seed0"].reason and "no checkpoint" in states["k_int1-seed1"].reason
    assert "tried again (1 of 1)" in printed and "given up after 2 tries" in printed
    assert "    IndexError: the toy broke" in printed and "another try cannot mend it" in printed
    # The next command begins with a clean slate, and what was mended goes through.
    set_fates(tmp_path, {})
    outcome, _, folder = sweep(write_sweep(tmp_path))
    assert outcome.exit_code("done") == 0 and not any(s.reason for s in outcome.states)
    assert not list((folder.root / "failed").iterdir())


def test_an_evaluation_that_ends_well_without_rows_has_failed(tmp_path, monkeypatch):
    set_fates(tmp_path, {"k_int1-seed1": ["", "no-rows"]})
    outcome, printed, _ = sweep(write_sweep(tmp_path))
    states = {s.name: s for s in outcome.states}
    assert outcome.exit_code("done") == 1 and states["k_int1-seed1"].state == "trained"
    what = "evaluate: ended, but what it should have written is not there: (nothing was printed)"
    assert states["k_int1-seed1"].reason == what and "given up after 2 tries" in printed
    assert [s.state for s in outcome.states].count("done") == 3


def test_a_run_out_of_memory_gets_twice_the_share(tmp_path, monkeypatch):
    set_fates(tmp_path, {"k_int0-seed0": ["oom", "oom"]})
    launch = {"runs_per_gpu": 4, "retries": 2, "jax_memory_share": 0.5}
    machine = Machine([Gpu("0", 100.0), Gpu("1", 100.0)], 1)
    outcome, printed, folder = sweep(write_sweep(tmp_path, seeds=3, launch=launch), machine)
    assert outcome.exit_code("done") == 0 and "tried again with twice the memory (1 of 2)" in printed
    fractions = [line.split()[1] for line in (folder.runs / "k_int0-seed0" / "tries").read_text().splitlines()]
    # 0.95 usable * share * 0.5 for JAX, at a quarter, a half and the whole of a GPU.
    assert fractions == ["0.119", "0.237", "0.475"]
    # Six runs of a quarter each were spread over both GPUs.
    seen = {(folder.runs / run.name / "tries").read_text().split()[0] for run in folder.sweep.runs}
    assert seen == {"0", "1"}


def test_a_run_on_two_devices_gets_two_gpus(tmp_path, monkeypatch):
    set_fates(tmp_path, {})
    path = write_sweep(tmp_path, seeds=1, settings={"run": {"num_timesteps": 50, "devices": 2}})
    outcome, _, folder = sweep(path, Machine([Gpu("0", 100.0), Gpu("1", 100.0)], 1))
    assert outcome.exit_code("done") == 0
    tries = [(folder.runs / run.name / "tries").read_text().split() for run in folder.sweep.runs]
    assert tries == [["0,1", "0.570"]] * 2  # 0.95 usable * 0.6 for JAX


def test_time_limit_stops_with_what_was_done_and_the_same_command_goes_on(tmp_path, monkeypatch):
    slow = {f"k_int{k}-seed{s}": ["slow"] for k in (0, 1) for s in (0, 1)}
    set_fates(tmp_path, slow)
    path = write_sweep(tmp_path, steps=10_000)
    logs = [tmp_path / "small" / "runs" / f"k_int0-seed{s}" / "metrics.jsonl" for s in (0, 1)]
    # Time flies once the first two are at work.
    outcome, printed, folder = sweep(path, limit_s=40.0, clock=lambda: 41.0 if all(map(last_line, logs)) else 0.0)
    assert outcome.timed_out and outcome.exit_code("done") == 3
    assert "time limit of 40 s: 2 run(s) write their checkpoints" in printed
    assert sorted(s.state for s in outcome.states) == ["stopped", "stopped", "waiting", "waiting"]
    stopped = {s.name: s.env_steps for s in outcome.states if s.state == "stopped"}
    assert all(0 < steps < 10_000 for steps in stopped.values())
    for name in stopped:  # it ended by itself, after SIGTERM
        assert json.loads((folder.runs / name / "summary.json").read_text())["completed"] is False
    set_fates(tmp_path, {})
    outcome, printed, _ = sweep(path)
    assert outcome.exit_code("done") == 0
    first_two = [line.split()[2].rstrip(":") for line in printed.splitlines() if "started (cpu)" in line][:2]
    assert set(first_two) == set(stopped)  # what was begun goes first


def running(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGINT, marks=pytest.mark.heavy), signal.SIGTERM, signal.SIGKILL]
)
def test_children_end_with_the_sweep_however_it_ends(tmp_path, number):
    path = write_sweep(tmp_path, steps=100_000)
    program = (
        "import sys; from train.sweep.__main__ import main; from tests.train.sweep.test_sweep import FAKE\n"
        f"sys.exit(main([{str(path)!r}], FAKE))"
    )
    slow = {f"k_int{k}-seed{s}": ["slow"] * 9 for k in (0, 1) for s in (0, 1)}
    set_fates(tmp_path, slow)
    env = {**os.environ, "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    process = subprocess.Popen(
        [sys.executable, "-c", program], env=env, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    logs = [tmp_path / "small" / "runs" / f"k_int0-seed{s}" / "metrics.jsonl" for s in (0, 1)]
    deadline = time.monotonic() + 60
    while not all(last_line(log) for log in logs) and time.monotonic() < deadline:
        time.sleep(0.1)
    pids = [last_line(log)["pid"] for log in logs]
    assert all(running(pid) for pid in pids)
    if number == signal.SIGINT:  # as a terminal does it: to the whole group
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    printed, _ = process.communicate(timeout=60)
    assert process.returncode == (-9 if number == signal.SIGKILL else 128 + number)
    deadline = time.monotonic() + 20
    while any(running(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(running(pid) for pid in pids)
    for log in logs:  # each saved before it ended
        assert json.loads((log.parent / "summary.json").read_text())["env_steps"] == last_line(log)["env_steps"]
    if number != signal.SIGKILL:
        assert f"{number.name}: 2 run(s) write" in printed and "the same command continues" in printed


def test_a_run_that_somebody_else_works_on_is_left_alone(tmp_path):
    path = write_sweep(tmp_path)
    folder = SweepFolder(spec.load_sweep(str(path)))
    folder.prepare()
    held = take_lock(folder.lock("k_int0-seed1"))
    assert held is not None and is_locked(folder.lock("k_int0-seed1")) and not is_locked(folder.lock("k_int0-seed0"))
    outcome, printed, _ = sweep(path)
    os.close(held)
    assert outcome.elsewhere == 1 and tries(folder)["k_int0-seed1"] == 0
    assert "train k_int0-seed1: somebody else works on it" in printed
    assert sorted(s.state for s in outcome.states) == ["done", "done", "done", "running"]
    outcome, _, _ = sweep(path)
    assert outcome.exit_code("done") == 0 and outcome.elsewhere == 0


def test_a_lock_that_is_free_again_is_tried_again(tmp_path, monkeypatch):
    """Whoever held the lock for an instant does not work on the run: it is not left to him."""
    refused = []

    def once_held(path):
        if len(refused) < 1:
            refused.append(path)
            return None
        return take_lock(path)

    monkeypatch.setattr(jobs, "take_lock", once_held)
    clock = itertools.count(0.0, 2.0)
    alone = write_sweep(tmp_path, grid={"env.k_int": [0.0], "run.seed": [0]})
    outcome, printed, folder = sweep(alone, clock=lambda: next(clock))
    assert printed.count("somebody else works on it") == 1
    assert outcome.exit_code("done") == 0 and outcome.elsewhere == 0
    assert {s.state for s in outcome.states} == {"done"} and set(tries(folder).values()) == {1}


def test_one_held_lock_does_not_keep_the_others_from_evaluation(tmp_path, monkeypatch):
    """Four runs are to be evaluated by one process when somebody takes one of them."""
    path = write_sweep(tmp_path)
    sweep(path, stages=("train",))
    theirs = []

    def taken_before(path):
        if path.name == "k_int0-seed1" and not theirs:
            theirs.append(take_lock(path))
        return take_lock(path)

    monkeypatch.setattr(jobs, "take_lock", taken_before)
    outcome, printed, folder = sweep(path)
    states = {s.name: s.state for s in outcome.states}
    assert states.pop("k_int0-seed1") == "running" and set(states.values()) == {"done"}
    assert outcome.elsewhere == 1 and outcome.exit_code("done") == 0 and set(tries(folder).values()) == {1}
    os.close(theirs[0])


def test_what_is_neither_done_nor_worked_on_is_no_success(tmp_path):
    path = write_sweep(tmp_path)
    outcome, _, _ = sweep(path, stages=("evaluate",))  # nothing is trained yet
    assert {s.state for s in outcome.states} == {"waiting"} and outcome.exit_code("done") == 1
    done, running = RunState("a", "done", 9, 9, {}), RunState("b", "running", 3, 9, {})
    assert Outcome((done, running), None, False, 1).exit_code("done") == 0
    stopped = RunState("c", "stopped", 3, 9, {})
    assert Outcome((done, stopped), None, False, 0).exit_code("done") == 1
    trained = RunState("d", "trained", 9, 9, {})
    assert [Outcome((done, trained), None, False, 0).exit_code(far) for far in ("trained", "done")] == [0, 1]


@pytest.mark.heavy
def test_two_identical_sweeps_share_the_work(tmp_path):
    """Both begin in an empty folder at the same time: every run is trained once, and both end well."""
    path = write_sweep(tmp_path)
    with ThreadPoolExecutor(2) as pool:
        ended = list(pool.map(lambda _: sweep(path), range(2)))
    for outcome, printed, _ in ended:
        assert outcome.exit_code("done") == 0 and "ended with" not in printed
    folder = ended[0][2]
    assert set(tries(folder).values()) == {1}
    assert {folder.state(run).state for run in folder.sweep.runs} == {"done"}
    assert len(list(folder.rows.iterdir())) == 4 and len(list((folder.root / "configs").iterdir())) == 4


def test_a_run_whose_next_stage_another_sweep_has_begun_did_not_fail(tmp_path, monkeypatch):
    """Its lock is held again before the first sweep looks: it was trained all the same."""
    held = []
    usual = Machine.ended

    def ended(self):
        over = usual(self)
        held.extend(take_lock(job.locks[0]) for job, _ in over if job.kind == "train")
        return over

    monkeypatch.setattr(Machine, "ended", ended)
    outcome, printed, _ = sweep(write_sweep(tmp_path))
    assert printed.count(": done") == 4 and "tried again" not in printed
    assert outcome.elsewhere == 4 and outcome.exit_code("done") == 0
    for descriptor in held:
        os.close(descriptor)


def test_shares_of_a_machine(tmp_path):
    listing = "0, GPU-aa, 143771\n1, GPU-bb, 143771\nnonsense\n"
    gpus = parse_gpus(listing, None)
    assert [g.name for g in gpus] == ["0", "1"] and gpus[0].memory_gb == pytest.approx(150.75, abs=0.01)
    assert [g.name for g in parse_gpus(listing, "1")] == ["1"]
    assert [g.name for g in parse_gpus(listing, "GPU-bb,GPU-aa")] == ["GPU-bb", "GPU-aa"]
    assert parse_gpus(listing, "") == []
    launch = LaunchConfig(runs_per_gpu=4, gpu_memory_gb=60.0, jax_memory_share=0.5)
    job = RunJob("job", (), tmp_path / "log", kind="train", runs=(), launch=launch)

    def taken(machine: Machine):
        if (share := machine.take(job)) is not None:
            machine.running.append((job, None, share))
        return share

    machine = Machine(gpus, 1)
    shares = [taken(machine) for _ in range(5)]
    # 0.95 * 150.75 GB hold two runs of 60 GB, not four; the emptier GPU comes first.
    assert [share[0] if share else None for share in shares] == ["0", "1", "0", "1", None]
    assert shares[0] is not None
    assert job.env_on(*shares[0]) == {
        "CUDA_DEVICE_ORDER": "PCI_BUS_ID",
        "CUDA_VISIBLE_DEVICES": "0",
        "XLA_PYTHON_CLIENT_MEM_FRACTION": "0.237",
    }
    del machine.running[0]
    assert taken(machine) == shares[0] and taken(machine) is None
    # Whole GPUs for a run on two devices, once they are idle; all where it wants more, so that it says what is missing.
    pair = dataclasses.replace(job, gpus=2.0)
    assert machine.take(pair) is None
    for wanted, given in ((2.0, "0,1"), (3.0, "0,1")):
        idle = Machine(gpus, 1)
        share = idle.take(dataclasses.replace(pair, gpus=wanted))
        assert share is not None and share == (given, 1.0)
        idle.running.append((pair, None, share))
        assert taken(idle) is None
    assert pair.env_on("0,1", 2.0)["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.475"
    cpu = Machine([], 2)
    assert [taken(cpu) for _ in range(3)] == [(None, 0.5), (None, 0.5), None]


def test_exit_codes():
    done, trained = RunState("a", "done", 9, 9, {}), RunState("b", "trained", 9, 9, {})
    failed, waiting = RunState("c", "failed", 3, 9, {}, "train: x"), RunState("d", "waiting", 0, 9, {})
    assert Outcome((done, done), None, True, 0).exit_code("done") == 0
    assert Outcome((done, trained), None, False, 0).exit_code("trained") == 0
    assert Outcome((done, waiting), None, True, 0).exit_code("done") == 3
    assert Outcome((done, waiting, failed), None, True, 0).exit_code("done") == 1
    assert Outcome((done, waiting, failed), 15, False, 0).exit_code("done") == 143
    running = RunState("e", "running", 400, 1000, {"env_steps_per_s": 5.0})
    assert totals([done, running]) == "2 runs: 1 running, 1 done; 600 env steps left at 5 a second: about 2 min"


def test_status_prints_every_run_and_does_nothing(tmp_path, capsys):
    path = write_sweep(tmp_path)
    assert main([str(path), "--status"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("waiting") == 5 and "k_int1-seed1" in printed and not (tmp_path / "small").exists()
    assert main([str(path), "--resume"]) == 2
    assert "holds no sweep; leave --resume out" in capsys.readouterr().err
    assert find_gpus() is not None


def test_impossible_words_are_one_line(tmp_path, capsys):
    path = str(write_sweep(tmp_path))
    for words, message in (
        (["--time-limit", "nan"], "--time-limit is nan, expected a positive number"),
        (["--where", "env.k_int=["], "--where 'env.k_int=[': not readable"),
    ):
        assert main([path, *words], FAKE) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line


def test_a_fifo_in_place_of_metrics_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "metrics.jsonl")
    assert last_line(tmp_path / "metrics.jsonl") == {}
