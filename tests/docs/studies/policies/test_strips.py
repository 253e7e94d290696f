import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import interactive_nav
from docs.studies.policies.strips import LENS, floor_seen, main, touched_longest
from interactive_nav.pictures.replay import EpisodePlayer, Replay, save_replay
from scenes_mjcf.look import straight_down


@pytest.fixture(scope="module")
def played(room):
    """The scene and four steps of a robot that stands."""
    env = interactive_nav.make("turtlebot", [room], backend="native", num_objects=2, episode_steps=4)
    return env.scenes[0], EpisodePlayer(env, lambda obs, key: jnp.zeros(2), "stands").play(jax.random.PRNGKey(1))


def _touching(replay: Replay, names: list[str | None]) -> Replay:
    """The robot stands on the named bodies after each step, and touches one where a name is given."""
    pos_w = replay.body_pos_w.copy()
    for step, name in enumerate(names, 1):
        pos_w[step, 0] = pos_w[step, replay.bodies.index(name)] if name else 99.0
    return dataclasses.replace(replay, body_pos_w=pos_w, touches_movable=np.array([bool(name) for name in names]))


def test_what_was_touched_in_most_steps_is_found(played):
    scene, replay = played
    first, second = replay.bodies[-2:]
    assert touched_longest(_touching(replay, [first, second, second, None]), scene) == second
    assert touched_longest(_touching(replay, [first, None, first, second]), scene) == first
    assert touched_longest(_touching(replay, [None] * 4), scene) is None


def test_the_floor_seen_is_where_the_rays_of_the_corners_end():
    camera = straight_down(np.array([-3.0, 1.0]), np.array([2.0, 2.5]), 4 / 3, LENS.fov_deg)
    rays = LENS.rays(camera)
    floor = camera.pos_w + rays * (camera.pos_w[2] / -rays[..., 2:])
    pixel_m = floor[0, 1, 0] - floor[0, 0, 0]
    want = [floor[0, 0, 0], floor[0, -1, 0], floor[-1, 0, 1], floor[0, 0, 1]]  # the first row is the greatest y
    np.testing.assert_allclose(floor_seen(camera), np.add(want, np.array([-1, 1, -1, 1]) * pixel_m / 2), atol=1e-6)


def test_a_strip_is_drawn_and_said(played, tmp_path, capsys):
    replay = _touching(played[1], [played[1].bodies[-1]] * 4)
    save_replay(replay, tmp_path / "a.npz")
    main(["--strip", str(tmp_path / "a.npz"), "stands", "--at", "0", "9", "-o", str(tmp_path / "a.webp")])
    assert f"touched {replay.bodies[-1]} longest, success 0" in capsys.readouterr().out
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.size == (1056, 266)
