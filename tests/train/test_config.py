"""Settings from files and words: what is read is what was written, and every mistake is named."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest

from interactive_nav.config import ORIGINAL_CODE
from interactive_nav_common.config import field_docs
from interactive_nav_common.errors import ConfigError
from train import config_io
from train.config import AUTO, EnvConfig, PPOConfig, RunConfig, TrainConfig, resolve, validate
from train.config_io import apply_overrides, flatten, from_yaml, help_text, load_config, to_yaml

BASE = TrainConfig(env=EnvConfig(scenes=("a",)))


def test_round_trip_of_every_kind_of_value():
    config = TrainConfig(
        env=EnvConfig.of(scenes=("a", "b c"), k_int=1.0, success_distance_m=0.4),
        ppo=PPOConfig(learning_rate=1e-7, num_envs=8, policy_hidden_layer_sizes=(3,)),
        run=RunConfig(name="x", tensorboard=False, num_timesteps=10**12),
    )
    assert from_yaml(to_yaml(config)) == config
    assert from_yaml(to_yaml(TrainConfig())) == TrainConfig()
    assert from_yaml("") == TrainConfig()


@pytest.mark.parametrize("name", config_io.preset_names())
def test_presets_load_resolve_and_differ_only_where_they_say(name, monkeypatch):
    monkeypatch.setattr(config_io, "scene_folders", tuple)  # not every preset's homes are packaged
    config = load_config(name)
    resolved = resolve(config, "native")
    assert from_yaml(to_yaml(resolved)) == resolved
    assert resolved.run.name == f"{name}-seed0"
    defaults, given = flatten(TrainConfig()), flatten(config)
    plain = (config_io.PRESET_DIR / f"{name}.yaml").read_text()
    for key, value in given.items():
        if value != defaults[key] and key != "run.name":
            assert f"{key.rpartition('.')[2]}:" in plain


def test_overrides():
    config = apply_overrides(
        BASE,
        [
            "ppo.learning_rate=1e-4",
            "env.scenes=a,b",
            "ppo.value_hidden_layer_sizes=[8, 9]",
            "run.num_timesteps=2e6",
        ],
    )
    assert config.ppo.learning_rate == 1e-4
    assert config.env.scenes == ("a", "b")
    assert config.ppo.value_hidden_layer_sizes == (8, 9)
    assert config.run.num_timesteps == 2_000_000 and isinstance(config.run.num_timesteps, int)
    assert apply_overrides(BASE, ["ppo.num_envs=5", "ppo.num_envs=auto"]).ppo.num_envs is None
    masks = [
        apply_overrides(BASE, [f"env.segmentation_classes={word}"]).env.segmentation_classes for word in ("all", 5)
    ]
    assert masks == ["all", 5]
    assert BASE.ppo.learning_rate == 3e-4  # nothing is changed in place


def test_two_words_that_only_fit_together():
    words = ["run.log_every_steps=2000000", "run.checkpoint_every_steps=4000000"]
    assert apply_overrides(BASE, words).run.log_every_steps == 2_000_000


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("ppo.learnin_rate=1", "unknown key 'ppo.learnin_rate', did you mean 'ppo.learning_rate'?"),
        ("k_int=1", "unknown key 'k_int', did you mean 'env.k_int'?"),
        ("ppo.seed=1", "unknown key 'ppo.seed', did you mean 'run.seed'?"),
        ("ppo.num_envs=2.5", "ppo.num_envs is 2.5, expected a whole number"),
        ("ppo.num_envs=true", "ppo.num_envs is True, expected a whole number"),
        ("ppo.num_envs=0", "ppo.num_envs is 0, expected at least 1"),
        ("ppo.learning_rate=fast", "ppo.learning_rate is 'fast', expected a number"),
        ("ppo.learning_rate=nan", "ppo.learning_rate is 'nan', expected a number"),
        ("ppo.learning_rate=0", "ppo.learning_rate is 0.0, expected a positive number"),
        ("ppo.discounting=1.5", "ppo.discounting is 1.5, expected between 0 and 1"),
        ("ppo.policy_hidden_layer_sizes=[64, x]", "ppo.policy_hidden_layer_sizes[1] is 'x', expected a whole number"),
        ("run.tensorboard=1", "run.tensorboard is 1, expected true or false"),
        ("run.name=a/b", "run.name is 'a/b', expected one folder name"),
        ("env.k_int=-1", "env.k_int is -1.0, expected 0 or more"),
        ("env.segmentation_classes=6", "env.segmentation_classes is 6, expected one of 4, 5, all"),
        ("env.backend=wrap", "env.backend is 'wrap', expected one of"),
        ("algorithm=pop", "algorithm is 'pop', expected one of ppo, sac, ddpg, clone, did you mean 'ppo'?"),
        ("run.wandb_project=x", "run.wandb_project is 'x', which changes nothing here: expected wandb true"),
        (
            "env.image_fov_deg=90",
            "image_fov_deg is 90.0, which changes nothing here: expected one of depth, segmentation, rgb",
        ),
        ("ppo=3", "ppo: got 3, expected a mapping"),
        ("ppo.num_envs", "expected key=value"),
        (
            "run.log_every_steps=2000000",
            "checkpoint_every_steps is 1000000, expected at least log_every_steps",
        ),
    ],
)
def test_mistakes_are_named(word, message):
    with pytest.raises(ConfigError) as caught:
        apply_overrides(BASE, [word])
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("sac.tau=0.1", "sac.tau is 0.1, which changes nothing here: expected algorithm sac; or leave it out"),
        ("ddpg.num_envs=7", "ddpg.num_envs is 7, which changes nothing here: expected algorithm ddpg"),
        ("network.image_features=64", "network.image_features is 64, .*: expected images among env.observations"),
    ],
)
def test_sections_without_a_use_are_left_out(word, message):
    config = apply_overrides(BASE, ["env.scenes=x", word])
    with pytest.raises(ConfigError, match=message):
        validate(config)
    used = ["env.observations=[depth]"] if word.startswith("network") else [f"algorithm={word.partition('.')[0]}"]
    validate(apply_overrides(config, used))
    for backend in ("native", "warp"):  # whose sizes are written for all sections
        resolved = resolve(apply_overrides(BASE, ["env.scenes=x"]), backend)
        assert resolved.sac.num_envs != BASE.sac.num_envs and from_yaml(to_yaml(resolved)) == resolved
        validate(resolved)


def test_minibatches_must_share_the_environments_out():
    config = apply_overrides(BASE, ["ppo.num_envs=48", "ppo.batch_size=16", "ppo.num_minibatches=4"])
    with pytest.raises(ConfigError, match="is 64 sequences, expected a multiple of ppo.num_envs \\(48\\)"):
        validate(config)
    with pytest.raises(ConfigError, match="env.scenes is empty"):
        validate(TrainConfig())


@pytest.mark.parametrize("backend", sorted(AUTO["ppo"]))
def test_resolve_fills_what_was_left_open(backend):
    resolved = resolve(dataclasses.replace(BASE, ppo=PPOConfig(unroll_length=7)), backend)
    assert resolved.env.backend == backend
    assert resolved.ppo.unroll_length == 7
    assert resolved.ppo.num_envs == AUTO["ppo"][backend]["num_envs"]
    assert None not in (resolved.ppo.batch_size, resolved.ppo.num_minibatches)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match=r"kint.yaml is a sweep, expected one run; python -m train.sweep .*kint.yaml"):
        load_config("sweeps/kint")
    with pytest.raises(ConfigError, match="no preset 'demos', did you mean 'demo'"):
        load_config("demos")
    with pytest.raises(ConfigError, match="no such file"):
        load_config(str(tmp_path / "none.yaml"))
    (tmp_path / "bad.yaml").write_text("env: [1")
    with pytest.raises(ConfigError, match="bad.yaml: not readable as YAML"):
        load_config(str(tmp_path / "bad.yaml"))
    (tmp_path / "list.yaml").write_text("- 1")
    with pytest.raises(ConfigError, match="list.yaml: the file: got"):
        load_config(str(tmp_path / "list.yaml"))
    (tmp_path / "mine.yaml").write_text("env: {scenes: [a]}\nrun: {seed: 4}\n")
    assert load_config(str(tmp_path / "mine.yaml")).run.name == "mine-seed4"


def test_help_lists_every_setting_with_default_and_meaning():
    lines = {line.split("=")[0].strip(): line for line in help_text().splitlines()}
    for name in flatten(TrainConfig()):
        assert len(lines[name].split(None, 1)) == 2 and lines[name].split(None, 1)[1]
    assert "ppo.learning_rate=0.0003" in lines["ppo.learning_rate"]
    assert "warp: 4096" in lines["ppo.num_envs"]
    for part in (EnvConfig, PPOConfig, RunConfig, TrainConfig):
        assert set(field_docs(part)) >= {field.name for field in dataclasses.fields(part)}


def test_command_line_says_one_line_and_exits_2():
    done = subprocess.run(
        [sys.executable, "-m", "train", "--config", "demo", "ppo.learnin_rate=1"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("train: override: unknown key 'ppo.learnin_rate', did you mean 'ppo.learning_rate'?")


def test_the_preset_of_the_original_code_holds_all_its_values():
    config = config_io.load_config("turtlebot_ppo_code")
    assert {key: getattr(config.env, key) for key in ORIGINAL_CODE} == ORIGINAL_CODE
    assert config.ppo.discounting == 0.98


def test_a_set_of_scenes_stands_for_its_folders():
    assert config_io.load_config("turtlebot_ppo", ["env.scenes=sparse/test"]).env.scenes == (
        "scenes_mjcf/rowan",
        "scenes_mjcf/willow",
    )
