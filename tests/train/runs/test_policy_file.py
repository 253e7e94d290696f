"""The small file of a policy: holds all that acting reads, nothing else, and acts nearly as the original."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import flax.serialization
import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from interactive_nav_common.runs import weights
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train import config_io
from train.config import EnvConfig, TrainConfig, resolve
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointError
from train.runs.run import train_run

TOY = EnvConfig.of(scenes=("toy",), backend="native")


def learner_of(env, algorithm, share):
    network = dataclasses.replace(SMALL, share_encoder=share)
    config = resolve(TrainConfig(env=TOY, algorithm=algorithm), "native")
    config = dataclasses.replace(config, network=network)  # the toy shows images that its config does not name
    template = ALGORITHMS[algorithm].template(env, config)
    leaves, structure = jax.tree.flatten(template)
    rng = np.random.default_rng(3)  # what begins as zeros shall not agree by chance

    def drawn(leaf):
        shape, dtype = np.shape(leaf), jnp.asarray(leaf).dtype
        if not jnp.issubdtype(dtype, jnp.floating) or not shape:
            return leaf
        if len(shape) == 1:
            return jnp.asarray(rng.uniform(0.05, 0.3, shape), dtype)
        return jnp.asarray(rng.normal(size=shape) / np.sqrt(np.prod(shape[:-1])), dtype)

    return config, jax.tree.unflatten(structure, [drawn(leaf) for leaf in leaves])


def actions(env, config, learner):
    size, rng = env.observation_size, np.random.default_rng(0)
    shapes = size if isinstance(size, dict) else {"": (size,)}
    seen = {
        name: rng.integers(0, 256, (40, *shape)).astype(np.uint8)
        if name.startswith("pixels/")
        else rng.normal(size=(40, *shape)).astype(np.float32)
        for name, shape in shapes.items()
    }
    act: Any = ALGORITHMS[config.algorithm].policy(env, config, learner, True)
    return np.asarray(act(seen if isinstance(size, dict) else seen[""], jax.random.PRNGKey(0))[0])


def saved(root, algorithm, learner):
    meta = checkpoint.CheckpointMeta(5, 1.0, 0.5, algorithm, "turtlebot", ("goal",), 3, 2)
    return checkpoint.save_snapshot(root, Snapshot(5, learner, None), meta, 1, 1.0)


@pytest.mark.parametrize("algorithm", ["ppo", "sac", "ddpg"])
@pytest.mark.parametrize(("env", "share"), [(ToyPixels(), False), (ToyPixels(), True)])
def test_what_acting_reads_and_no_more(tmp_path, monkeypatch, env, share, algorithm):
    monkeypatch.setattr(weights.rounded, "__defaults__", (1024,))  # these networks are small
    config, learner = learner_of(env, algorithm, share)
    before = actions(env, config, learner)
    path = saved(tmp_path / "whole", algorithm, learner)
    checkpoint.keep_policy(path, tmp_path / "kept" / path.name, step=0.03)
    kept, _ = checkpoint.find(tmp_path / "kept", "best")
    tensors, about = weights.read_weights(kept / checkpoint.POLICY, CheckpointError, "")
    assert [about[name] for name in ("algorithm", "robot", "observations", "env_steps")] == [
        *(algorithm, "turtlebot", ["goal"], 5)
    ]
    lost = next(name for name in tensors if "policy" in name)
    shutil.copytree(kept, tmp_path / "less")
    weights.write_weights(tmp_path / "less" / checkpoint.POLICY, {k: v for k, v in tensors.items() if k != lost}, about)
    with pytest.raises(CheckpointError, match=f"lacks {lost}, which this network reads; export the run again"):
        checkpoint.load_learner(tmp_path / "less", ALGORITHMS[algorithm].template(env, config))
    assert not checkpoint.is_whole(kept) and checkpoint.is_whole(path)
    assert sum(p.stat().st_size for p in kept.iterdir()) < 0.5 * sum(p.stat().st_size for p in path.iterdir())
    template = ALGORITHMS[algorithm].template(env, config)
    after = actions(env, config, checkpoint.load_learner(kept, template))
    assert np.abs(actions(env, config, template) - before).max() > 0.1
    assert 0 < np.abs(after - before).mean() < 0.02 and np.abs(after - before).max() < 0.3
    # Everything else may be anything; none of what is kept may.
    state = flax.serialization.to_state_dict(learner)
    acting = checkpoint.policy_leaves(path, state, algorithm)
    parts = {"ppo": "params/policy/ normalizer_params/"}.get(algorithm, "policy_params/ normalizer_params/").split()
    parts += [{"ppo": "params/encoder/"}.get(algorithm, "q_params/encoder/")] if share else []
    flat: dict[str, Any] = flax.traverse_util.flatten_dict(state, sep="/", keep_empty_nodes=True)
    assert list(acting) == [name for name in flat if name.startswith(tuple(parts))]  # in the order of the learner
    broken = {k: v if k in acting or not hasattr(v, "dtype") else jnp.full_like(v, 7) for k, v in flat.items()}
    other = flax.serialization.from_state_dict(template, flax.traverse_util.unflatten_dict(broken, sep="/"))
    np.testing.assert_array_equal(actions(env, config, other), before)
    idle = ("count", "summed_variance", "std_eps")  # of the normaliser: it acts by mean and deviation
    for name in acting:
        if name.rpartition("/")[2].startswith(idle) or any(f"/{word}" in name for word in idle):
            continue
        moved = {**flat, name: jnp.asarray(flat[name]) * 1.5 + 0.3}
        other = flax.serialization.from_state_dict(template, flax.traverse_util.unflatten_dict(moved, sep="/"))
        assert np.abs(actions(env, config, other) - before).max() > 1e-6, name


def test_foreign_and_damaged_files_are_told(tmp_path):
    config, learner = learner_of(ToyPixels(), "sac", True)
    path = saved(tmp_path / "whole", "sac", learner)
    checkpoint.keep_policy(path, tmp_path / "kept" / path.name)
    kept, _ = checkpoint.find(tmp_path / "kept", "best")
    other = dataclasses.replace(resolve(TrainConfig(env=TOY), "native"), network=config.network)
    with pytest.raises(CheckpointError, match="policy_params/.*which this network has not"):
        checkpoint.load_learner(kept, ALGORITHMS["ppo"].template(ToyPixels(), other))
    unknown = dataclasses.replace(checkpoint.read_meta(path), algorithm="ppo2")
    (path / checkpoint.META).write_text(json.dumps(dataclasses.asdict(unknown)))
    with pytest.raises(
        CheckpointError, match="learner.msgpack: holds no policy of 'ppo2', expected one of ppo, sac, d"
    ):
        checkpoint.keep_policy(path, tmp_path / "unknown")
    files = (path, checkpoint.LEARNER), (kept, checkpoint.POLICY)
    digests = [hashlib.sha256((home / name).read_bytes()).hexdigest() for home, name in files]
    assert [checkpoint.weights_digest(home) for home in (path, kept)] == digests
    (kept / checkpoint.POLICY).write_bytes(b"PK garbage")
    with pytest.raises(CheckpointError, match="policy.safetensors: not readable"):
        checkpoint.load_learner(kept, ALGORITHMS["sac"].template(ToyPixels(), config))


def test_training_does_not_go_on_from_it_but_starts_from_it(tmp_path):
    config = toy_config(tmp_path, updates=2)
    _, folder, _ = train_run(config, Console(quiet=True), build_env=build_toy)
    path, _ = checkpoint.find(folder.checkpoints, "last")
    checkpoint.keep_policy(path, tmp_path / "kept")
    shutil.rmtree(path)
    (tmp_path / "kept").rename(path)
    assert json.loads((path / checkpoint.META).read_text())["env_steps"] == 512
    home = Path(shutil.move(folder.path, tmp_path / "my copy"))
    resumed = dataclasses.replace(config, run=dataclasses.replace(config.run, name=home.name, num_timesteps=2048))
    with pytest.raises(CheckpointError, match="holds the policy alone") as refused:
        train_run(resumed, Console(quiet=True), build_env=build_toy)
    # The command that it says to type starts a run with that policy.
    words = shlex.split(str(refused.value).rpartition("start a new run: ")[2])
    assert words[:5] == ["python", "-m", "train", "--config", str(home / "config.yaml")]
    new = config_io.load_config(words[4], words[5:])
    assert new.run.init == str(home) and new.run.name == "NEW"
    _, started, _ = train_run(new, Console(quiet=True), build_env=build_toy)
    assert started.path == folder.path.parent / "NEW"
    assert checkpoint.find(started.checkpoints, "last")[1].env_steps == 512
