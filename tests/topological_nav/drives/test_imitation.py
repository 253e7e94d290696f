"""A policy learns a toy scene's drives; runs repeat, go on and refuse; what is loaded does what was learned."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from interactive_nav_common.config import overridden
from interactive_nav_common.errors import FileError
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.records import read_metrics
from topological_nav.__main__ import main
from topological_nav.config import PolicyConfig
from topological_nav.drives import imitation
from topological_nav.drives.dataset import drive_images
from topological_nav.drives.driving import Forward, Frames, Policy, embed_drives, load_policy
from topological_nav.learn.learning import Learner

WORDS = (
    *("hidden=24", "projection=8", "forward_hidden=16", "steps=20", "overlap_s=1.5", "batch=8", "epochs=10"),
    *("learning_rate=1e-2", "straight_kept=1"),
)
CONFIG = overridden(PolicyConfig(), WORDS)


@pytest.fixture(scope="module")
def frames(made, driven):
    return embed_drives([driven], made.rooms, made.passages, True)


@pytest.fixture(scope="module")
def run(frames, tmp_path_factory):
    out = tmp_path_factory.mktemp("policy") / "run"
    assert imitation.train_policy(frames, out, CONFIG) is not None
    assert len(read_metrics(out / "metrics.jsonl")) == 10
    return out


@pytest.mark.heavy
def test_all_images_and_their_mirrors_are_embedded(frames, driven):
    width = sum(network.embed(np.zeros((1, 32, 32, 3), np.uint8)).shape[1] for network in frames.networks)
    count = len(frames.drives.command)
    assert frames.features.shape == (2 * count, width)
    rows, images = next(iter(drive_images(driven)))
    at = frames.drives.rows(rows)[:3]
    for side, shown in ((0, images[:3]), (1, images[:3, :, ::-1])):
        expected = np.concatenate([network.embed(shown) for network in frames.networks], 1)
        assert frames.features[at + side * count].astype(float) == pytest.approx(expected, abs=2e-3)


def test_the_forward_model_learns_alone_first_and_then_everything(run):
    lines = read_metrics(run / "metrics.jsonl")
    assert [line["epoch"] for line in lines] == list(range(1, 11))
    first, second, last = lines[0], lines[1], lines[-1]
    # alpha (CE + CE) joins in the second epoch of ten: alone = 0.1.
    assert first["loss"] == pytest.approx(first["forward"], rel=1e-3)
    whole = second["forward"] + 10 * (second["ce_linear"] + second["ce_angular"]) + 0.5 * second["consistency"]
    assert second["loss"] == pytest.approx(whole, rel=1e-3)
    assert last["ce_linear"] < 0.8 * second["ce_linear"] and last["ce_angular"] < 0.8 * second["ce_angular"]
    results = json.loads((run / "results.json").read_text())
    assert set(results["test"]) == {"steps", "linear", "angular", "forward", "no_change"}
    assert np.sum(results["test"]["angular"]["confusion"]) == results["test"]["steps"]


@pytest.mark.parametrize("consistent", [0.0, 1.0])
def test_alone_the_forward_model_leaves_the_policy_as_it_is(frames, consistent):
    policy, forward, tx = Policy(6, 4), Forward(5), optax.adam(1e-2)
    params = imitation.fresh_params(policy, forward, 3, 0)
    learner = Learner(params, {"mean": jnp.zeros(3), "deviation": jnp.ones(3)}, tx.init(params))
    before = jax.tree.map(np.asarray, params)
    epoch = imitation.policy_epoch(policy, forward, 1e-2, 2, 4)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    labels = {
        "rows": jnp.asarray(rng.integers(0, 9, (4, 21))),
        "valid": jnp.ones((4, 20), bool),
        "followed": jnp.ones((4, 20), bool),
        "linear": jnp.zeros((4, 20), jnp.int32),
        "angular": jnp.zeros((4, 20), jnp.int32),
        **{"alpha": jnp.float32(10.0), "lam": jnp.float32(0.5), "jointly": jnp.float32(0.0)},
        "consistent": jnp.float32(consistent),
    }
    after, _ = epoch(learner, jnp.asarray(rng.normal(size=(9, 3)), jnp.float32), labels, jax.random.PRNGKey(0))
    same = jax.tree.map(lambda a, b: bool((np.asarray(a) == b).all()), after.params, before)
    assert all(jax.tree.leaves(same["policy"])) and not all(jax.tree.leaves(same["forward"]))


def test_a_stopped_run_ends_where_an_uninterrupted_one_does(frames, run, tmp_path, stop_after):
    out = tmp_path / "run"
    stop_after(4)
    with pytest.raises(Stopped):
        imitation.train_policy(frames, out, CONFIG)
    assert len(read_metrics(out / "metrics.jsonl")) == 4
    with pytest.raises(FileError, match="holds no trained policy; finish it"):
        load_policy(out)
    assert imitation.train_policy(frames, out, CONFIG) is not None
    assert (out / "weights.safetensors").read_bytes() == (run / "weights.safetensors").read_bytes()
    lines = [read_metrics(path / "metrics.jsonl") for path in (out, run)]
    strip = [[{k: v for k, v in line.items() if k != "seconds"} for line in one] for one in lines]
    assert strip[0] == strip[1]
    with pytest.raises(FileError, match="the run there has lam = 0.5, this one 1.0"):
        imitation.train_policy(frames, out, dataclasses.replace(CONFIG, lam=1.0))


def test_what_is_loaded_acts_as_the_cells_do_step_by_step(frames, run, made, driven):
    policy = load_policy(run, made.rooms, made.passages)
    rows, images = next(iter(drive_images(driven)))
    steps = int(min(frames.drives.steps[rows[:2]]))
    ends = np.cumsum(frames.drives.steps[rows])
    both = np.stack([images[:steps], images[ends[0] : ends[0] + steps]])
    state, found = policy.start(2), []
    for t in range(min(steps, 8)):
        state, linear, angular = policy.act(state, both[:, t])
        assert linear.shape == angular.shape == (2,)
        assert set(linear) <= {0.0, 0.25, 0.5} and set(angular) <= {-0.5, -0.25, 0.0, 0.25, 0.5}
        found.append((linear, angular))
    # One at a time, with a memory of its own, each does the same.
    alone = policy.start(1)
    for t in range(min(steps, 8)):
        alone, linear, angular = policy.act(alone, both[1:, t])
        assert (linear[0], angular[0]) == (found[t][0][1], found[t][1][1])
    with pytest.raises(FileError, match=r"images are \(16, 16, 3\), expected \(32, 32, 3\)"):
        policy.act(policy.start(1), np.zeros((1, 16, 16, 3), np.uint8))


def test_networks_are_found_from_the_run_and_must_be_the_same(frames, run, made, tmp_path):
    assert load_policy(run).about["parameters"] > 0
    other = tmp_path / "rooms"
    shutil.copytree(made.rooms, other)
    about = json.loads((other / "network.json").read_text())
    (other / "network.json").write_text(json.dumps({**about, "digest": "0" * 64}))
    with pytest.raises(FileError, match="is not the network that .* learned with; train the policy again"):
        load_policy(run, localiser=other)
    with pytest.raises(FileError, match="was trained for 'rooms', expected a run of 'train policy'"):
        load_policy(made.rooms)
    with pytest.raises(FileError, match="was trained for 'passages', expected a run of 'train rooms'"):
        load_policy(run, localiser=made.passages)


@pytest.mark.heavy
def test_the_command_draws_and_its_grid_is_a_table(made, driven, tmp_path, capsys):
    out = tmp_path / "grid"
    runs = ["--data", str(driven), "--localiser", str(made.rooms), "--detector", str(made.passages)]
    words = ["train", "policy", *runs, "--grid", "-o", str(out), *WORDS, "epochs=2", "mirror=false"]
    assert main(words) == 0
    rows = json.loads((out / "grid.json").read_text())
    assert [(r["alpha"], r["lambda"]) for r in rows] == imitation.GRIDS["nine"] and len(rows) == 9
    table = (out / "grid.md").read_text()
    assert table.count("\n") == 11 and table in capsys.readouterr().out
    assert len(list(out.glob("alpha-*-lambda-*/curves.png"))) == 9
    assert main([*words]) == 0  # all there: nothing is learned again
    assert "policy: epoch" not in capsys.readouterr().out


def test_drives_of_two_folders_are_learned_from_together(frames):
    both, count = Frames.joined([frames, frames]), len(frames.drives.command)
    assert Frames.joined([frames]) is frames and both.mirrored
    assert both.drives.scene.tolist() == [0] * len(frames.drives) + [1] * len(frames.drives)
    (header,) = both.header["folders"]  # alike but for their scenes: described once
    assert header == {**frames.header, "scenes": 2 * frames.header["scenes"]}
    faster = dataclasses.replace(frames, config=dataclasses.replace(frames.config, linear_m_s=0.8))
    with pytest.raises(FileError, match=r"have linear_m_s = \[0.5, 0.8\], expected one; drive again with one"):
        Frames.joined([frames, faster])
    assert both.drives.first.tolist() == [*frames.drives.first, *(frames.drives.first[1:] + count)]
    values = imitation.class_values(CONFIG, 0.5, 0.5)
    of_one, of_both = (imitation._split(part.drives, CONFIG, values)[0] for part in (frames, both))
    assert len(of_both) == 2 * len(of_one)
    for k, part in enumerate((of_one, imitation.mirrored(of_one, count, CONFIG))):
        mine = of_both.rows + k * 2 * count
        for half in np.split(mine, 2):
            assert (both.features[half] == frames.features[part.rows]).all()


def test_drives_seen_through_another_camera_are_refused(made, driven, tmp_path):
    copy = tmp_path / "drives"
    shutil.copytree(driven, copy)
    header = json.loads((copy / "drives.json").read_text())
    header["settings"]["width"] = 48
    (copy / "drives.json").write_text(json.dumps(header))
    with pytest.raises(
        FileError, match="images have width = 48, the networks learned from 32; drive again with width=32"
    ):
        embed_drives([copy], made.rooms, made.passages, False)


def test_embeddings_are_kept_for_the_next_training(made, driven, tmp_path):
    copy = tmp_path / "drives"
    shutil.copytree(driven, copy, ignore=shutil.ignore_patterns("embedded-*"))
    first = embed_drives([copy], made.rooms, made.passages, False)
    for images in copy.rglob("images-*.npz"):
        images.unlink()
    again = embed_drives([copy], made.rooms, made.passages, False)
    assert first.features.any() and (again.features == first.features).all()
    # Mirrored images were not embedded, and have to be there.
    with pytest.raises(FileError, match="is missing; the same 'data --drives' command goes on"):
        embed_drives([copy], made.rooms, made.passages, True)
    (kept,) = copy.glob("embedded-*.npy")
    kept.write_bytes(kept.read_bytes()[:200])
    with pytest.raises(FileError, match="not readable.*; delete it, and the images are embedded again"):
        embed_drives([copy], made.rooms, made.passages, False)
