"""A person's keys become actions: with viser's server and a stand-in for mjviser and for a browser."""

from __future__ import annotations

import contextlib
import sys
import types

import numpy as np
import pytest

import interactive_nav
from interactive_nav.task.rollout import episode_keys
from interactive_nav_common.errors import UserError
from train.scoring import driver
from train.scoring.evaluation import BatchPlayer

pytest.importorskip("viser", reason="viser is not installed (pip install 'viser>=1.1,<1.2')")


def test_keys_set_speeds_and_the_robot_drives_them(room, monkeypatch):
    drawn = []
    view = types.SimpleNamespace(update_from_mjdata=lambda data: drawn.append(data.xpos.copy()))
    stand_in = types.SimpleNamespace(ViserMujocoScene=lambda server, model, num_envs: view)
    monkeypatch.setitem(sys.modules, "mjviser", stand_in)
    env = interactive_nav.make("turtlebot", scenes=[str(room)], backend="native", episode_steps=10, num_objects=1)
    policy, camera = driver.Driver(env, port=0), types.SimpleNamespace()
    client = types.SimpleNamespace(camera=camera, atomic=contextlib.nullcontext)
    monkeypatch.setattr(policy._server, "get_clients", lambda: {0: client})
    opened = policy._open

    def press(*where):
        opened(*where)
        for key in ("arrowup", "arrowup", "arrowleft", "arrowup", "arrowdown"):
            policy._press(driver.KEYS[key])

    monkeypatch.setattr(policy, "_open", press)
    player = BatchPlayer(env, demonstrate=True)
    try:
        player.play(policy, episode_keys(0, 1))
        assert player.played is not None
        _, action, _, _ = player.played.values["steps"]
        # 0.2 m/s and 0.3 rad/s: wheels of 0.0352 m, 0.23 m apart, turn by -12.5 to 25 rad/s.
        wheels = (0.2 + np.array([-1, 1]) * 0.3 * 0.23 / 2) / 0.0352
        np.testing.assert_allclose(action[0], np.tile((wheels + 12.5) / 37.5 * 2 - 1, (10, 1)), atol=1e-5)
        assert len(drawn) == 10 and np.abs(drawn[-1] - drawn[0]).max() > 0.1
        policy._press(None)
        assert [slider.value for slider in policy._velocity] == [0.0, 0.0]
        with pytest.raises(UserError, match="set --batch 1"):
            player.play(policy, episode_keys(0, 2))
    finally:
        policy._server.stop()
