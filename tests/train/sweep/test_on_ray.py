"""The same sweeps on a real local Ray cluster of two nodes."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path

import pytest
from rich.console import Console

from interactive_nav_common.errors import ConfigError
from interactive_nav_common.jobs.on_ray import RayLauncher
from tests.train.sweep.test_sweep import FAKE, ROOT, running, set_fates, write_sweep
from train.sweep import spec
from train.sweep.folder import SweepDisplay, SweepFolder, last_line
from train.sweep.scheduler import Scheduler

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    quick = {"health_check_initial_delay_ms": 500, "health_check_period_ms": 500, "health_check_failure_threshold": 2}
    head = {"num_cpus": 1, "object_store_memory": 10**8, "_system_config": quick}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.add_node(num_cpus=1, object_store_memory=10**8)
    ray.init(address=cluster.address, log_to_driver=False)
    assert len([node for node in ray.nodes() if node["Alive"]]) == 2
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def sweep(path: Path, stops: list[int] | None = None, clock=time.monotonic, limit_s: float | None = None):
    console = Console(file=io.StringIO(), width=400)
    folder = SweepFolder(spec.load_sweep(str(path)))
    folder.prepare()
    launcher = RayLauncher("auto")
    with SweepDisplay(console) as display:
        scheduler = Scheduler(folder, launcher, display, programs=FAKE, clock=clock)
        outcome = scheduler.run(stops if stops is not None else [], limit_s, poll_s=0.1)
    launcher.close()
    return outcome, console.file.getvalue(), folder  # type: ignore[attr-defined]


@pytest.fixture(autouse=True)
def at_root(monkeypatch):
    monkeypatch.chdir(ROOT)


@pytest.mark.heavy
def test_runs_use_both_nodes_fail_alone_and_are_tried_again(cluster, tmp_path, monkeypatch):
    import ray

    path = write_sweep(tmp_path)
    fates = {"k_int0-seed0": ["crash"], "k_int0-seed1": ["slow"], "k_int1-seed0": ["refuse"], "k_int1-seed1": ["slow"]}
    set_fates(tmp_path, fates)
    used: set[str] = set()
    usual = RayLauncher.ended

    def counted(self: RayLauncher):
        used.update(a["NodeID"] for a in _actors(ray) if a["State"] == "ALIVE")
        return usual(self)

    monkeypatch.setattr(RayLauncher, "ended", counted)
    outcome, printed, folder = sweep(path)
    states = {s.name: s.state for s in outcome.states}
    assert states == {
        "k_int0-seed0": "done",
        "k_int0-seed1": "done",
        "k_int1-seed0": "failed",
        "k_int1-seed1": "done",
    }
    assert "train k_int0-seed0: ended with exit code 1, tried again (1 of 1)" in printed
    assert len((folder.runs / "k_int0-seed0" / "tries").read_text().splitlines()) == 2
    assert len(used) == 2  # each node holds one job at a time


def _actors(ray) -> list[dict]:
    from ray._private.state import actors

    return [{"State": a["State"], "NodeID": a["Address"]["NodeID"]} for a in actors().values()]


def test_time_limit_stops_jobs_on_the_cluster_cleanly(cluster, tmp_path, monkeypatch):
    slow = {f"k_int{k}-seed{s}": ["slow"] * 9 for k in (0, 1) for s in (0, 1)}
    set_fates(tmp_path, slow)
    path = write_sweep(tmp_path, steps=100_000)
    logs = [tmp_path / "small" / "runs" / f"k_int0-seed{s}" / "metrics.jsonl" for s in (0, 1)]
    outcome, _, folder = sweep(path, clock=lambda: 41.0 if all(map(last_line, logs)) else 0.0, limit_s=40.0)
    assert outcome.timed_out and sorted(s.state for s in outcome.states) == ["stopped", "stopped", "waiting", "waiting"]
    for log in logs:
        assert json.loads((log.parent / "summary.json").read_text())["env_steps"] == last_line(log)["env_steps"]
        assert not running(last_line(log)["pid"])


@pytest.mark.heavy
def test_a_lost_node_is_a_failure_like_another(cluster, tmp_path, monkeypatch):
    import ray

    set_fates(tmp_path, {"k_int0-seed0": ["slow"], "k_int1-seed0": ["slow"]})
    path = write_sweep(tmp_path, steps=600, seeds=1)
    logs = [tmp_path / "small" / "runs" / f"k_int{k}-seed0" / "metrics.jsonl" for k in (0, 1)]
    node, killed = cluster.list_all_nodes()[-1], []
    usual = RayLauncher.ended

    def then_lose_a_node(self: RayLauncher):
        if not killed and all(map(last_line, logs)):
            set_fates(tmp_path, {})
            pids = {log: last_line(log)["pid"] for log in logs}
            cluster.remove_node(node, allow_graceful=False)
            killed.append(pids)
        return usual(self)

    monkeypatch.setattr(RayLauncher, "ended", then_lose_a_node)
    outcome, printed, folder = sweep(path)
    assert (
        killed
        and "ended by SIGHUP, tried again" in printed.replace("exit code -1", "SIGHUP")
        or "tried again" in printed
    )
    assert {s.state for s in outcome.states} == {"done"}
    tries = [len((log.parent / "tries").read_text().splitlines()) for log in logs]
    assert sorted(tries) == [1, 2]
    assert ray.is_initialized()


def test_no_cluster_is_one_line(monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)

    def refuse(**_):
        raise ConnectionError("Could not find any running Ray instance.\nmore")

    monkeypatch.setattr(ray, "init", refuse)
    with pytest.raises(
        ConfigError, match=r"no cluster at 'auto' \(Could not find any running Ray instance.\); start one"
    ):
        RayLauncher("auto")
