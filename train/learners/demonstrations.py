"""Write and read demonstrations: a Parquet file with a row for each control step, its columns named as in LeRobot."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from interactive_nav.sensing.description import KEY, describe, difference
from interactive_nav.task.rollout import Recorder, Rollout
from interactive_nav_common.errors import ConfigError, readable
from interactive_nav_common.files import whole_file, writing
from interactive_nav_common.versions import versions
from train.learners.networks import PIXELS

RECORDERS = {
    "first_observation": Recorder(lambda state, action: state.obs, "start"),
    "steps": Recorder(lambda state, action: (state.obs, action, state.reward, state.done), "step"),
}
"""What `table_of` needs of a rollout, besides `success`."""


def column_of(name: str) -> str:
    """Return the column of a part of an observation: `state`, or an image such as `pixels/depth`."""
    return "observation." + name.replace(PIXELS, "images.")


def _lists(values: np.ndarray) -> pa.FixedSizeListArray:
    """Return rows [R, ...] as lists of one size."""
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), int(np.prod(values.shape[1:])))


def table_of(env: Any, played: Rollout, success: np.ndarray, policy: str, first_episode: int = 0) -> pa.Table:
    """Return the control steps of N episodes, numbered from `first_episode`; `success` is [N]."""
    (after, action, reward, done), scenes = played.values["steps"], [scene.name for scene in env.scenes]
    taken = np.arange(reward.shape[1]) < played.num_steps[:, None]
    episode, frame = np.nonzero(taken)
    first = played.values["first_observation"]
    before = jax.tree.map(lambda a, b: np.concatenate([a[:, None], b], 1)[:, :-1][taken], first, after)
    before = before if isinstance(before, Mapping) else {"state": before}
    action = np.clip(np.where(np.isfinite(action), action, 0.0), -1.0, 1.0)  # as the environment takes it
    columns = {column_of(name): _lists(value) for name, value in before.items()} | {
        "action": _lists(action[taken].astype(np.float32)),
        "episode_index": first_episode + episode,
        "frame_index": frame,
        "timestamp": (frame * env.config.control_dt_s).astype(np.float32),
        "next.reward": reward[taken],
        "next.done": done[taken] > 0,
        "success": success[episode] > 0,
    }
    same = {"robot": [env.robot.name] * len(episode), "policy": [policy] * len(episode)}
    return pa.table(columns | {"scene": [scenes[i] for i in played.first.scene_index[episode]]} | same)


def write_demonstrations(tables: Sequence[pa.Table], env: Any, path: Path) -> None:
    """Write control steps with a description of their columns, units and rate."""
    about, table = describe(env), pa.concat_tables(tables)
    sizes = env.observation_size if isinstance(env.observation_size, Mapping) else {"state": (env.observation_size,)}
    features: dict[str, Any] = {}
    for column in table.schema:
        of_list = pa.types.is_fixed_size_list(column.type)
        dtype = str(column.type.value_type if of_list else column.type)
        features[column.name] = {"dtype": {"float": "float32"}.get(dtype, dtype), "shape": [1], "names": None}
    for name, shape in sizes.items():
        features[column_of(name)]["shape"] = list(shape)
    if "state" in sizes:
        names = [f"{part}.{i}" for part, size in env.sensors.sizes.items() for i in range(size)]
        features[column_of("state")]["names"] = names
    features["action"] |= {"shape": [env.action_size], "names": about["outputs"]["action"]["names"]}
    about |= {"fps": about["robot"]["rate_hz"], "features": features, "commit": versions()["commit"]}
    with writing(path, "choose another --demonstrations"), whole_file(path) as partial:
        schema = table.schema.with_metadata({KEY: json.dumps(about)})
        pq.write_table(table.cast(schema), partial, compression="zstd")


def read_demonstrations(path: Path, env: Any, only_successful: bool) -> tuple[Any, np.ndarray]:
    """Return an environment's observations [R, ...] and actions [R, A]; raise `ConfigError` where they do not fit."""
    problem, remedy = f"clone.demonstrations: {path}", "record them again (python -m train.evaluate --demonstrations)"
    size = env.observation_size
    shapes = size if isinstance(size, Mapping) else {"state": (size,)}
    with readable(path, ConfigError, remedy, " as demonstrations"):
        about = json.loads((pq.read_schema(path).metadata or {})[KEY.encode()])
        differs = difference(about, describe(env))
        if differs:
            raise ConfigError(f"{problem}: {differs}; record with these settings, or set env.* and --robot")
        table = pq.read_table(path, columns=[*map(column_of, shapes), "action", "success"])
        table = table.filter(pc.field("success")) if only_successful else table

        def array(column: str, shape: Sequence[int]) -> np.ndarray:
            return table[column].combine_chunks().flatten().to_numpy().reshape(-1, *shape)

        observation = {name: array(column_of(name), shape) for name, shape in shapes.items()}
        action = array("action", (env.action_size,))
    if not len(action):
        raise ConfigError(f"{problem}: holds no step of a successful episode; record more, or set clone.episodes=all")
    return observation if isinstance(size, Mapping) else observation["state"], action
