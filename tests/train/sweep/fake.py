"""Programs in place of `python -m train` and `python -m train.evaluate`, quick and obedient: for tests of sweeps.

`python -m tests.train.sweep.fake train --config FILE` counts to run.num_timesteps in a run folder, ten steps at a
time; what goes wrong on the way stands in fates.json beside the sweep's folder, {run: [what the first try does, ...]}:
crash, oom, refuse or slow, and no-evaluation (or no-rows: it ends well and leaves none).
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import yaml

from interactive_nav_common.files import whole_file, write_text


def fates(run: Path) -> dict[str, list[str]]:
    path = run.parents[2] / "fates.json"  # <here>/<sweep>/runs/<run>
    return json.loads(path.read_text()) if path.is_file() else {}


def train(path: str) -> int:
    config = yaml.safe_load(Path(path).read_text())["run"]
    run, total = Path(config["out_dir"]) / config["name"], config["num_timesteps"]
    run.mkdir(parents=True, exist_ok=True)
    with open(run / "tries", "a") as file:
        file.write(
            f"{os.environ.get('CUDA_VISIBLE_DEVICES', '-')} {os.environ.get('XLA_PYTHON_CLIENT_MEM_FRACTION')}\n"
        )
    tries = len((run / "tries").read_text().splitlines())
    plan = fates(run).get(config["name"], [])
    fate = plan[tries - 1] if tries <= len(plan) else ""
    if fate == "crash":
        raise IndexError("the toy broke")
    if fate == "oom":
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 8 bytes")
    if fate == "refuse":
        print("train: env.scenes is empty, expected at least one", file=sys.stderr)
        return 2
    stops: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: stops.append(number))
    metrics = run / "metrics.jsonl"
    steps = json.loads(metrics.read_text().splitlines()[-1])["env_steps"] if metrics.is_file() else 0
    while steps < total and not stops:
        if fate == "slow":
            time.sleep(0.1)
        steps += 10
        with open(metrics, "a") as file:
            file.write(json.dumps({"env_steps": steps, "env_steps_per_s": 100.0, "pid": os.getpid()}) + "\n")
    done = steps >= total
    summary = {"completed": done, "env_steps": steps, "wall_s": 1.0}
    write_text(run / "summary.json", json.dumps(summary))  # whole, as runs write it: the sweep reads it meanwhile
    return 0 if done else 128 + stops[0]


def evaluate(words: list[str]) -> int:
    import pyarrow as pa  # `train` starts without these: sweeps start it hundreds of times
    import pyarrow.parquet as pq

    from train.runs.run_folder import EvaluationRequest

    def after(flag: str) -> str:
        return words[words.index(flag) + 1]

    runs = [Path(word) for word in words[: words.index("--dataset")]]
    plan = fates(runs[0])
    for run in runs:
        if "no-evaluation" in plan.get(run.name, []):
            print(f"train.evaluate: {run}: no checkpoint", file=sys.stderr)
            return 2
        if "no-rows" in plan.get(run.name, []):
            return 0
        asked = EvaluationRequest(
            scenes=tuple(Path(scene).name for scene in words[words.index("--scenes") + 1 :]),
            policies=("learned",),
            episodes=int(after("--episodes")),
            seed=int(after("--seed")),
            balanced="--balanced" in words,
            checkpoint=after("--checkpoint"),
            deterministic="--no-stochastic" in words,
        )
        steps = json.loads((run / "summary.json").read_text())["env_steps"]
        rows = pa.table({"run": [run.name], "with": [len(runs)]})
        path = Path(after("--dataset")) / asked.file_name(run.name)
        with whole_file(path) as partial:
            pq.write_table(rows.replace_schema_metadata({"trained_steps": json.dumps(steps)}), partial)
    return 0


if __name__ == "__main__":
    sys.exit(train(sys.argv[3]) if sys.argv[1] == "train" else evaluate(sys.argv[2:]))
