"""Drive by hand: a policy whose actions come from the arrow keys and sliders of a page in the browser."""

import time
from typing import Any

import numpy as np

from interactive_nav.pictures.scene_model import CUT_WALLS, HIDDEN, ROBOT, THINGS, SceneModel
from interactive_nav.task.rollout import HostPolicy
from interactive_nav_common.errors import UserError, missing, optional
from interactive_nav_common.signals import raise_stop
from interactive_nav_common.untrusted.guard import guarded_server
from train.scoring.policies import need_twist

KEYS = {"arrowup": (0.1, 0.0), "arrowdown": (-0.1, 0.0), "arrowleft": (0.0, 0.3), "arrowright": (0.0, -0.3)}
"""Key -> what a press adds to the linear (m/s) and to the angular (rad/s) velocity; the space bar stops."""


class Driver(HostPolicy):
    """A person who drives one episode after the other in real time."""

    def __init__(self, env: Any, port: int = 8080):
        need_twist(env.robot, "policy keyboard")
        self._env, self._viewer = env, optional("mjviser", missing("policy keyboard", "mjviser", "view"))
        self._server, address = guarded_server("127.0.0.1", port, "drive", "view")
        twist, gui = env.robot.twist, self._server.gui
        limits = ("forward, m/s", twist.max_linear_m_s), ("left, rad/s", twist.max_angular_rad_s)
        self._velocity = [gui.add_slider(label, -most, most, 0.05, 0.0) for label, most in limits]
        for key, change in KEYS.items():
            gui.add_command(key, hotkey=key).on_trigger(lambda _, change=change: self._press(change))
        gui.add_command("stop", hotkey="space").on_trigger(lambda _: self._press(None))
        print(f"drive with the arrow keys, stop with the space bar: {address}", flush=True)

    def _press(self, change: tuple[float, float] | None) -> None:
        for slider, add in zip(self._velocity, change or (0.0, 0.0), strict=True):
            slider.value = float(np.clip(slider.value + add, slider.min, slider.max)) if change else 0.0

    def _open(self, scene: int, goal_xy_w: np.ndarray) -> None:
        """Show a scene and the goal; wait until somebody looks."""
        self._press(None)
        env, self._due_s = self._env, 0.0
        self._model = SceneModel(env.robot, env.scenes[scene], env.world.small_objects)
        shown = np.isin(group := self._model.model.geom_group, (THINGS, CUT_WALLS, ROBOT))
        group[:] = np.where(shown, 0, HIDDEN)
        self._server.scene.reset()
        self._view = self._viewer.ViserMujocoScene(self._server, self._model.model, num_envs=1)
        self._view.camera_tracking_enabled = False
        self._server.scene.add_icosphere("/goal", 0.15, (0, 158, 115), position=(*goal_xy_w, 0.15))
        while not self._server.get_clients():
            raise_stop()
            time.sleep(0.1)

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> np.ndarray:
        """Return the action [1, A] of one control step, when its time has come."""
        if len(episode) > 1:
            raise UserError("policy keyboard: one episode at a time can be driven; set --batch 1")
        nav = state.info["nav"]
        scene, (x, y, _), yaw = int(nav.scene_index[0]), *map(np.asarray, (nav.robot_pos_w[0], nav.yaw_rad[0]))
        if step == 0:
            self._open(scene, np.asarray(nav.goal_xy_w[0]))
        self._model.pose(self._env.world, scene, np.asarray(state.pipeline_state.qpos[0]))
        self._view.update_from_mjdata(self._model.data)
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position = np.array([x, y, 1.8]) - 1.5 * ahead
                client.camera.look_at = np.array([x, y, 0.2]) + ahead
        now_s = time.monotonic()
        self._due_s = max(now_s, self._due_s + self._env.config.control_dt_s)
        time.sleep(self._due_s - now_s)
        forward, turn = (np.array([slider.value]) for slider in self._velocity)
        return np.asarray(self._env.robot.drive(forward, turn, np), np.float32)
