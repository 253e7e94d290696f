"""The settings of `preset=report`: each does what the report states, by values."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from interactive_nav import load_scene
from interactive_nav_common.errors import ConfigError, FileError
from topological_nav import adaptation
from topological_nav import config as configs
from topological_nav.config import DataConfig, EvaluationConfig, MapConfig
from topological_nav.data import dataset
from topological_nav.data.domains import AdaptConfig
from topological_nav.drives.driving import Forward, Policy, fresh_params
from topological_nav.drives.imitation import GRIDS
from topological_nav.evaluate.evaluation import NavigatorPlayer, draw_episodes
from topological_nav.learn import training
from topological_nav.learn.learning import initial, variable_shapes
from topological_nav.learn.networks import Network
from topological_nav.maps import graph
from topological_nav.navigate.navigator import Navigator
from topological_nav.presets import PRESETS, configured
from topological_nav.scenes.space import find_rooms, free_space

PARTS = {
    "data": DataConfig(),
    "drives": configs.DriveConfig(),
    "rooms": configs.TASKS["rooms"],
    "passages": configs.TASKS["passages"],
    "policy": configs.PolicyConfig(),
    "map": MapConfig(),
    "evaluate": EvaluationConfig(),
    "adapt": AdaptConfig(),
}


def report(part: str, *words: str):
    return configured(PARTS[part], ["preset=report", *words], part)


def test_a_preset_lies_under_the_words_and_over_the_defaults():
    assert set(PRESETS["report"]) == set(PARTS)
    seen = report("evaluate", "images=2")
    assert (seen.images, seen.goal_images, seen.match, seen.glance, seen.limit_s) == (2, 1, "nearest", False, 175.0)
    assert seen.runs * seen.run_s == 60.0  # twelve runs of 5 s
    rooms, passages, policy = report("rooms"), report("passages"), report("policy")
    assert (rooms.batch, rooms.epochs, rooms.learning_rate, rooms.hidden, rooms.width) == (20, 15, 1e-4, 512, 64)
    assert (passages.batch, passages.epochs, passages.hidden) == (32, 20, 512)
    assert (policy.hidden, policy.epochs, policy.batch, policy.alone) == (500, 1000, 50, 0.1)
    with pytest.raises(ConfigError, match="preset is 'reprot', expected one with settings of 'map': report"):
        configured(MapConfig(), ["preset=reprot"], "map")


def test_two_networks_give_1152_numbers():
    width = 0
    for part, outputs in (("rooms", 68), ("passages", 1)):
        config = report(part)
        network = Network(part, config.network, config.width, config.hidden, outputs, config.first_stage)
        shapes = variable_shapes(network, (48, 64))
        images = jax.ShapeDtypeStruct((1, 48, 64, 3), jnp.uint8)
        width += jax.eval_shape(lambda v, x, n=network: n.apply(v, x, method="embed"), shapes, images).shape[1]
        # Two layers of 512 stand behind either backbone.
        layers = [shapes["params"][f"layers_{k}"]["kernel"].shape for k in range(2)]
        assert layers == [(512, 512), (512, 512)]
    assert width == 1152


def test_a_detector_without_layers_is_its_last_layer_of_the_mean_map():
    network = Network("passages", "resnet18", 4, 0, 1, 1)
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (2, 32, 32, 3)), jnp.uint8)
    variables = initial(variable_shapes(network, (32, 32)), 0)
    embedded = network.apply(variables, images, method="embed")
    assert embedded.shape == (2, 4 + 32)  # the first stage and the last
    assert "layers_0" not in variables["params"]


def test_rooms_with_few_positions_have_no_images(two_rooms):
    scene = load_scene(two_rooms)
    space = free_space(scene, 1.1)
    config = DataConfig(num_rooms=2, positions=20, max_per_room=20, passage_length_m=1.0, passage_lengths_m=(1.0,))
    counts = np.bincount(dataset.plan_scene(scene, space, config).room, minlength=2)
    assert counts.min() > 0 and counts[0] != counts[1]
    few = dataclasses.replace(config, least_per_room=int(counts.max()))
    kept = np.bincount(dataset.plan_scene(scene, space, few).room, minlength=2)
    assert kept.tolist() == [count if count == counts.max() else 0 for count in counts]


def test_random_headings_to_test_are_as_many_and_of_the_same_places(made):
    rooms = dataset.load_rooms(made.data)
    config = dataclasses.replace(configs.TASKS["rooms"], pitch="level", test_headings="random", seed=3)
    work = training._work("rooms", made.data, config)
    held = rooms.images[rooms.test, configs.PITCHES.index("level")]
    assert work.held_out.shape == (len(held) * 6, *held.shape[2:])
    shown = work.held_out.reshape(len(held), 6, *held.shape[2:])
    places = [
        [np.flatnonzero((every == one).all((1, 2, 3)))[0] for one in some]
        for every, some in zip(held, shown, strict=True)
    ]
    assert all(len(set(map(int, p))) == 6 for p in places)  # no image twice
    assert len({tuple(map(int, p)) for p in places}) > 1  # other headings at other places
    assert work.groups["level"].tolist() == list(range(len(work.held_out)))
    # Of all three pitches, images of a position follow each other by pitch.
    work = training._work("rooms", made.data, dataclasses.replace(config, pitch="all"))
    assert work.groups["down"].tolist() == [i for i in range(len(work.held_out)) if i // 6 % 3 == 2]
    assert (work.held_out[work.groups["level"]] == shown.reshape(-1, *held.shape[2:])).all()


def test_scenes_to_test_passages_by_give_nothing_to_learn_from(made, monkeypatch):
    passages = dataset.load_passages(made.data)
    config = dataclasses.replace(configs.TASKS["passages"], test_scenes=("painted",))
    with pytest.raises(FileError, match="has no passages to learn from; name fewer test_scenes"):
        training._work("passages", made.data, config)
    # As if every second image were of another scene.
    halves = dataclasses.replace(passages, scene=np.arange(len(passages.images), dtype=np.int32) % 2)
    with monkeypatch.context() as patched:
        patched.setattr(training, "load_passages", lambda _: halves)
        patched.setattr(training, "read_header", lambda _: ({"scenes": [{"name": "painted"}, {"name": "other"}]}, None))
        work = training._work("passages", made.data, config)
    assert (work.held_out == passages.images[::2]).all() and (work.images == passages.images[1::2]).all()
    with pytest.raises(FileError, match="has no scene elm, expected among painted"):
        training._work("passages", made.data, dataclasses.replace(config, test_scenes=("elm",)))


def test_random_nodes_have_the_density_of_the_spacing(two_rooms):
    space = free_space(load_scene(two_rooms), 1.1)
    rooms = find_rooms(space, "kmeans", 2, None, 0, 0.2)
    config = MapConfig(nodes="random", connect=False, spacing_m=1.0)
    xy, lacking = graph.place_nodes(space, rooms, config, 0.225, 50)
    places = space.centres(config.clearance_m)
    area_m2 = np.bincount(rooms.of(places)) * space.resolution_m**2
    assert np.bincount(rooms.of(xy)).tolist() == [max(3, round(area)) for area in area_m2] and lacking == []
    assert (space.at(xy) >= config.clearance_m).all() and len(np.unique(xy, axis=0)) == len(xy)
    other, _ = graph.place_nodes(space, rooms, dataclasses.replace(config, seed=1), 0.225, 50)
    assert not np.array_equal(other, xy)


def test_the_forward_model_may_give_the_next_embedding_itself():
    params = fresh_params(Policy(hidden=4), Forward(5, False), 3, 0)["forward"]
    last = {**params["Dense_2"], "bias": jnp.asarray([1.0, 2.0, 3.0])}
    u, action = jnp.full((1, 3), 7.0), jnp.zeros((1, 8))
    arguments = ({"params": {**params, "Dense_2": last}}, u, u, action, jnp.full(3, 10.0))
    assert np.asarray(Forward(5, False).apply(*arguments))[0] == pytest.approx([1.0, 2.0, 3.0])
    assert np.asarray(Forward(5).apply(*arguments))[0] == pytest.approx([17.0, 27.0, 37.0])


def test_the_pairs_are_those_of_table_ii():
    assert GRIDS[report("policy").pairs] == [(0.1, 0.5), (10.0, 0.1), (50.0, 1.0)]
    assert len(GRIDS[configs.PolicyConfig().pairs]) == 9


def test_the_goal_is_one_image_along_a_heading_of_the_episode(two_rooms):
    scene = load_scene(two_rooms)
    space = free_space(scene, 1.1)
    rooms = find_rooms(space, "kmeans", 2, None, 0, 0.2)
    config = EvaluationConfig(images=1, goal_images=1, seed=5)
    episodes = draw_episodes(scene.digest, space, rooms, 4, config)
    looked = {}

    class Sees(Navigator):
        def __init__(self):
            self.config = config

        def goal_nodes(self, images, heading_rad):
            looked["images"], looked["heading_rad"] = images, heading_rad
            return np.zeros(len(images), np.int32)

        def start(self, goal):
            return goal

    player = object.__new__(NavigatorPlayer)
    player.config, player._navigator = config, Sees()
    player.player = SimpleNamespace(env=SimpleNamespace(robot=SimpleNamespace(body_width_m=0.45)))  # type: ignore[assignment]
    player._camera = lambda xy, yaw, _: np.concatenate([xy, yaw[:, None]], -1)
    player.begin(episodes)
    assert looked["images"].shape == (4, 1, 3) and looked["heading_rad"].shape == (4, 1)
    assert np.asarray(looked["images"][:, 0, :2]) == pytest.approx(episodes.goal_xy_w)
    assert looked["images"][:, 0, 2] == pytest.approx(looked["heading_rad"][:, 0])
    assert len(set(looked["heading_rad"][:, 0])) == 4
    whole = looked["heading_rad"].copy()
    player.begin(episodes.take(np.array([2])))  # whoever else is in the batch
    assert looked["heading_rad"][0, 0] == whole[2, 0]


def test_a_target_may_have_more_free_images_than_blocked_ones(made):
    passages = dataset.load_passages(made.data)
    config = AdaptConfig(domain="clean", fine_tune=10, fine_tune_free=7, test=6, test_free=2)
    learned, tested = adaptation.labelled(made.data, passages.lengths_m, config)
    assert learned.free[:, 1].sum() == 7 and len(learned.images) == 10
    assert tested.free[:, 1].sum() == 2 and len(tested.images) == 6
