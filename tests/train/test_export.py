"""Policies as ONNX files: what JAX computes, a description of every number, and episodes as the run plays them."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest

import interactive_nav
from interactive_nav.interop.onnx_file import OnnxError
from interactive_nav.robots import get_robot
from interactive_nav.sensing.description import KEY, describe
from tests.train.toy_env import ToyConfig, ToyEnv
from tests.train.toy_pixels import SMALL, ToyPixels
from tests.train.toy_run import build_toy, toy_config
from train import evaluate, export
from train.config import DDPGConfig, SACConfig
from train.learners.algorithms import ALGORITHMS
from train.learners.learner import Snapshot
from train.runs import checkpoint
from train.runs.checkpoint import CheckpointMeta
from train.runs.run_folder import RunFolder
from train.scoring.brought import OnnxPolicy

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
SIZES: dict[str, Any] = {"policy_hidden_layer_sizes": (16,), "q_hidden_layer_sizes": (16,)}
KINDS = {
    "ppo": (ToyEnv, "ppo"),
    "ppo-images": (ToyPixels, "ppo"),
    "sac-images": (ToyPixels, "sac"),
    "ddpg": (ToyEnv, "ddpg"),
}
WORDS = ["--episodes", "12", "--seed", "4", "--no-stochastic"]


def write_run(path: Path, env: ToyEnv, algorithm: str) -> tuple[RunFolder, Any]:
    """Write a run of one checkpoint, with random weights and a normaliser that changes what it is given."""
    config = dataclasses.replace(
        toy_config(path), algorithm=algorithm, network=SMALL, sac=SACConfig(**SIZES), ddpg=DDPGConfig(**SIZES)
    )
    template, rng = ALGORITHMS[algorithm].template(env, config), np.random.default_rng(3)

    def disturbed(x: Any) -> Any:
        return (
            x + 0.2 * rng.standard_normal(x.shape).astype(np.float32) if getattr(x, "dtype", None) == np.float32 else x
        )

    learner = jax.tree.map(disturbed, template)
    folder = RunFolder(path / "toy")
    folder.open(config)
    meta = CheckpointMeta(
        *(640, 1.0, 0.75, algorithm, "turtlebot", config.env.observations),
        observation_size=checkpoint.plain_size(env.observation_size),
        action_size=2,
        scenes={"plane": "task-1:plane"},
    )
    checkpoint.save_snapshot(folder.checkpoints, Snapshot(640, learner, None), meta, 1, 0.0)
    return folder, ALGORITHMS[algorithm].policy(env, config, learner, True)


@pytest.fixture(scope="module", params=list(KINDS))
def exported(request, tmp_path_factory):
    make, algorithm = KINDS[request.param]
    path = tmp_path_factory.mktemp(request.param)
    folder, policy = write_run(path, make(), algorithm)
    assert export.main([str(folder.path), "-o", str(path / "policy.onnx")], build_env=lambda config: make()) == 0
    return make(), policy, path / "policy.onnx"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that has been evaluated, and its policy's file."""
    path = tmp_path_factory.mktemp("run")
    folder, _ = write_run(path, ToyEnv(), "ppo")
    assert evaluate.main([str(folder.path), *WORDS, "--policies", "learned"], build_env=build_toy) == 0
    assert export.main([str(folder.path), "-o", str(path / "policy.onnx")], build_env=build_toy) == 0
    return folder, path / "policy.onnx"


def about(path: Path) -> Any:
    return json.loads(onnxruntime.InferenceSession(path).get_modelmeta().custom_metadata_map[KEY])


@pytest.mark.parametrize("batch", [1, 7])
def test_the_graph_gives_the_actions_of_jax_and_the_robots_units(exported, batch):
    env, policy, path = exported
    rng, images = np.random.default_rng(0), isinstance(env, ToyPixels)
    vector = 3 * rng.standard_normal((batch, 6 if images else 29)).astype(np.float32)
    if images:
        shape = (batch, 12, 12, 1)
        pixels = {f"pixels/{n}": rng.integers(0, 256, shape, np.uint8) for n in ("depth", "segmentation")}
        inputs, observation = {"velocity": vector, **pixels}, {"state": vector, **pixels}
    else:
        inputs = {"waypoints": vector[:, :20], "goal": vector[:, 20:23], "velocity": vector[:, 23:]}
        observation = vector
    action, command, twist = onnxruntime.InferenceSession(path).run(["action", "command", "twist"], inputs)
    expected = np.asarray(policy(observation, jax.random.PRNGKey(0))[0])
    assert batch == 1 or expected.std(0).min() > 1e-2  # it depends on what it is given
    np.testing.assert_allclose(action, expected, atol=1e-5)
    # A TurtleBot's wheels of 0.0352 m turn by -12.5 to 25 rad/s, 0.23 m apart.
    np.testing.assert_allclose(command, -12.5 + 37.5 * (expected + 1) / 2, rtol=1e-4, atol=1e-4)
    left, right = 0.0352 * command.T
    np.testing.assert_allclose(twist.T, [(left + right) / 2, (right - left) / 0.23], rtol=1e-4, atol=1e-5)


def test_the_file_says_what_it_takes_and_gives(run):
    folder, path = run
    got = about(path)
    named = {"name": "turtlebot", "control_mode": "native", "rate_hz": 10.0}
    assert got["robot"] == named | {"base_height_m": 0.0, "success_distance_m": 0.333}
    assert got["inputs"]["waypoints"]["spacing_m"] == 0.2
    assert list(got["inputs"]) == ["waypoints", "goal", "velocity"]
    assert got["inputs"]["velocity"] == {
        **{"shape": [6], "dtype": "float32", "unit": "m/s, rad/s", "scale": 1.0, "frame": "base", "range": None},
        **{"content": "linear x, y, z, then angular x, y, z", "rate_hz": 10.0},
    }
    command, twist = got["outputs"]["command"], got["outputs"]["twist"]
    assert command["names"] == ["wheel left rad/s", "wheel right rad/s"]
    assert (command["low"], command["high"]) == ([-12.5, -12.5], [25.0, 25.0])
    assert twist["names"] == ["linear.x m/s", "angular.z rad/s"]
    # Both wheels at an end, and one at each: 0.0352 m * 37.5 rad/s / 0.23 m.
    np.testing.assert_allclose([twist["low"], twist["high"]], [[-0.44, -5.73913], [0.88, 5.73913]], rtol=1e-5)
    policy, rows = got["policy"], pq.read_table(folder.path / "evaluation" / "episodes.parquet").to_pydict()
    assert (policy["algorithm"], policy["env_steps"], policy["run"]) == ("ppo", 640, "toy")
    assert policy["train_score"] == {"ins_0.5": 0.75} and policy["trained_in"] == ["plane"]
    assert policy["train_commit"] == json.loads((folder.path / "versions.json").read_text())["commit"]
    assert policy["evaluation"]["episodes"] == 12 and policy["evaluation"]["scenes"] == ["plane"]
    assert policy["evaluation"]["ins_0.5"] == pytest.approx(np.mean(rows["ins_0.5"]))


def test_jax_is_left_as_it_was(exported):
    assert jax.numpy.cumsum.__module__.startswith("jax.")


def test_cameras_and_scales():
    """Of a depth of u8 over 5 m, a share of 5.6 m for a lidar, and the TurtleBot's camera turned to the left."""
    env = interactive_nav.make(
        "turtlebot",
        scenes=[str(Path(__file__).parents[2] / "scenes_mjcf" / "apartment_0")],
        backend="native",
        observations=("goal", "lidar", "depth", "segmentation"),
        cameras=[{"name": "left", "yaw_deg": 90, "pitch_deg": 20, "fov_deg": 70, "size": 32, "pos_m": (0.1, 0.0, 0.5)}],
        image_dtype="uint8",
    )
    got = describe(env)
    inputs, (camera,) = got["inputs"], got["cameras"]
    assert list(inputs) == ["goal", "lidar", "pixels/left/depth", "pixels/left/segmentation"]
    depth, lidar = inputs["pixels/left/depth"], inputs["lidar"]
    assert (depth["shape"], depth["dtype"], depth["unit"], depth["range"]) == ([32, 32, 1], "uint8", "m", [0, 255])
    assert depth["scale"] == pytest.approx(5.0 / 255)
    assert inputs["pixels/left/segmentation"]["scale"] == pytest.approx(11 / 255)
    assert (lidar["scale"], lidar["range"]) == (5.6, pytest.approx([0.05 / 5.6, 1]))
    assert got["lidar"]["lidar_rays"] == 228 and got["lidar"]["lidar_fov_deg"] == 240
    assert camera["inputs"] == "pixels/left/" and camera["pos_m"] == [0.1, 0.0, 0.5]
    assert [camera[f"{name}_deg"] for name in ("yaw", "pitch_down", "vertical_fov")] == pytest.approx([90, 20, 70])
    assert (camera["width"], camera["height"], camera["body"]) == (32, 32, env.robot.camera.body)


def test_its_episodes_are_those_of_the_run(run, tmp_path):
    folder, path = run
    rows = tmp_path / "rows.parquet"
    assert (
        evaluate.main(
            [str(folder.path), *WORDS, "--policies", f"learned,{path}", "--policy", f"mine={path}", "--out", str(rows)],
            build_env=build_toy,
        )
        == 0
    )
    played = pq.read_table(rows).to_pydict()
    assert [*dict.fromkeys(played["policy"])] == ["learned", "policy", "mine"]
    for name in ("robot_path_m", "episode_steps", "success", "ins_0.5"):
        values = np.array(played[name], float).reshape(3, 12)
        np.testing.assert_allclose(values[1:], values[:1].repeat(2, 0), rtol=1e-3, err_msg=name)
    assert np.ptp(values := np.array(played["robot_path_m"])[:12]) > 0.01 and values.min() > 0


def other(**changes: Any) -> ToyEnv:
    """The toy with attributes changed."""
    env = ToyEnv(ToyConfig())
    for name, value in changes.items():
        setattr(env, name, value)
    return env


class FewerWaypoints(ToyEnv):
    """The toy with nine numbers of waypoints less than its vector has otherwise."""

    def _observe(self, nav: Any) -> jax.Array:
        return super()._observe(nav)[2:]


def test_a_file_of_another_robot_or_observation_is_refused_in_one_line(run):
    path = run[1]
    fewer = FewerWaypoints()
    fewer.sensors.sizes = {"waypoints": 18, "goal": 3, "velocity": 6}
    renamed = ToyEnv()
    renamed.sensors.sizes = {"waypoints": 20, "goal": 3, "odometry": 6}
    slow = dataclasses.replace(get_robot("turtlebot"), action_high=(12.5, 12.5))
    for env, line in (
        (other(robot=get_robot("freight")), "name of robot in the file: 'turtlebot', in the environment: 'freight'"),
        (
            other(robot=get_robot("turtlebot", "twist")),
            "control_mode of robot in the file: 'native', in the environment: 'twist'",
        ),
        (
            renamed,
            "names of inputs in the file: ['waypoints', 'goal', 'velocity'], in the environment: ['way",
        ),
        (fewer, "shape of input waypoints in the file: [20], in the environment: [18]"),
        (ToyEnv(ToyConfig(waypoint_spacing_m=0.4)), "spacing_m of input waypoints in the file: 0.2, in"),
        (ToyEnv(ToyConfig(potential_round=1.0, waypoints_round=True)), "avoids of input waypoints in the file: None"),
        (other(robot=slow), "high of command in the file: [25.0, 25.0], in the environment: [12.5, 12.5]"),
    ):
        with pytest.raises(OnnxError, match=re.escape(line)) as failure:
            OnnxPolicy(path, env)
        assert "\n" not in str(failure.value)


def test_other_files_are_refused(run, tmp_path, capsys):
    folder, path = run
    plain, text, bad = tmp_path / "plain.onnx", tmp_path / "text.onnx", tmp_path / "bad.onnx"
    model = onnx.load(path)
    model.metadata_props[0].value = '{"robot": 3}'
    onnx.save(model, bad)
    del model.metadata_props[:]
    onnx.save(model, plain)
    text.write_text("no model")
    for file, line in (
        (plain, "not readable as an ONNX model (ValueError: it has no description)"),
        (bad, "not readable as an ONNX model (ValueError: it has no description)"),
        (text, "not readable as an ONNX model (InvalidProtobuf"),
        (tmp_path / "none.onnx", "no such file; expected a file of interactive-nav export"),
    ):
        assert evaluate.main([str(folder.path), "--policies", str(file)], build_env=build_toy) == 2
        (error,) = capsys.readouterr().err.strip().splitlines()
        assert f"{file}: {line}" in error


def test_what_differs_from_jax_is_not_written(run, tmp_path, capsys, monkeypatch):
    folder, out = run[0], tmp_path / "policy.onnx"
    right = export.outputs_of
    monkeypatch.setattr(
        export, "outputs_of", lambda *given: (right(*given)[0], 1.001 * right(*given)[1], right(*given)[2])
    )
    assert export.main([str(folder.path), "-o", str(out)], build_env=build_toy) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert "output command differs by 1.0e-03 between ONNX and JAX" in error and "1000 observations" in error
    assert not out.exists()
    assert export.main([str(folder.path), "-o", str(tmp_path / "policy.pt")], build_env=build_toy) == 2
    assert "expected a file that ends in .onnx" in capsys.readouterr().err


def test_the_pages_example_drives(run, monkeypatch):
    page = Path(__file__).parents[2] / "docs" / "from-a-checkpoint-to-a-robot.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert len(code.splitlines()) <= 20
    monkeypatch.chdir(run[1].parent)
    sent: list[Any] = []
    given = {"waypoints": np.ones(20), "goal": np.ones(3), "velocity": np.zeros(6)}
    namespace: dict[str, Any] = {"read_sensors": lambda: given, "publish": lambda *twist: sent.append(twist)}
    exec(code.replace("while True:", "for _ in range(2):"), namespace)
    batch = {name: value[None].astype(np.float32) for name, value in given.items()}
    (expected,) = onnxruntime.InferenceSession(run[1]).run(["twist"], batch)[0]
    np.testing.assert_allclose(sent, [expected, expected], rtol=1e-6)
