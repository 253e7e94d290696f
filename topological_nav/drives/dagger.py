"""Let a trained policy drive while the expert labels its states: DAgger (Ross, Gordon and Bagnell 2011).

A policy trained on the expert's drives alone never sees the consequences of its mistakes. `train policy` can add these
drives to the expert's.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from interactive_nav.task.rollout import HostPolicy
from interactive_nav_common.jobs.progress import Progress
from topological_nav.config import DriveConfig, NavigatorConfig
from topological_nav.data.folders import load_scenes, renderer_of
from topological_nav.drives.dataset import DRIVES, Drives, simulate_drives
from topological_nav.drives.driving import LocalPolicy, load_policy, need_camera
from topological_nav.drives.expert import CONTROL_S, Expert
from topological_nav.scenes.rendering import SceneRenderer, camera_pose

RUN_STEPS = round(NavigatorConfig().run_s / CONTROL_S)
"""Control steps after which the policy's memory is reset, as in the navigator."""


@jax.jit
def _taught(expert: Expert, memory: Any, state: Any) -> Any:
    return jax.vmap(expert.act, (0, 0, None))(memory, state, jax.random.PRNGKey(0))


class Pupil(HostPolicy):
    """Drive by a local policy, and in a share of the steps by the expert, until contact.

    The expert's memory holds the pose and the command that the expert would have given, whoever drove.
    """

    def __init__(self, expert: Expert, numbers: np.ndarray, driver: LocalPolicy, renderers: Sequence[SceneRenderer]):
        """Store the drives' numbers [B], which select the expert's steps, and a renderer for each scene."""
        self.remembers: Expert = expert
        self._numbers, self._driver, self._renderers = numbers, driver, renderers

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> Any:
        action, memory, over = _taught(self.remembers, state.info["policy"], state)
        over = np.asarray(over) | np.asarray(state.info["nav"].memory["touching"]).any(1)
        robot, config = self.remembers.env.robot, self.remembers.config
        if step % RUN_STEPS == 0:
            self._memory = jax.tree.map(np.array, self._driver.start(len(self._numbers)))
        images = np.zeros((len(episode), config.height, config.width, 3), np.uint8)
        pose_w, scene = np.asarray(memory["pose_w"]), np.asarray(memory["task"].scene)
        for index in np.unique(scene[running & ~over]):
            rows = np.flatnonzero(running & ~over & (scene == index))
            seen = camera_pose(robot, pose_w[rows, :2], pose_w[rows, 2], np.zeros(len(rows)))
            images[rows] = self._renderers[index].draw(seen)
        own, linear, angular = self._driver.act(jax.tree.map(lambda x: x[episode], self._memory), images)
        for every, new in zip(jax.tree.leaves(self._memory), jax.tree.leaves(own), strict=True):
            every[episode] = new
        shares = np.random.default_rng([config.seed, 10, step]).random(int(self._numbers.max()) + 1)
        by_expert = shares[self._numbers[episode]] < config.expert_share
        driven = np.asarray(robot.drive(linear, angular, np), np.float32)
        return np.where(by_expert[:, None], np.asarray(action), driven), over, memory


def simulate_driven(
    scene_folders: Sequence[Path], out: Path, config: DriveConfig, progress: Progress = lambda *_: None
) -> Drives:
    """Simulate missing drives with the run `driver` at the wheel; the folder's settings hold its weights' digest."""
    driver = load_policy(config.driver)
    need_camera(out, DRIVES.describe(config, []), driver.networks)
    config = dataclasses.replace(config, driver=driver.about["digest"])
    renderers = [renderer_of(scene, config) for scene in load_scenes(scene_folders, config.engine)]
    pupil = functools.partial(Pupil, driver=driver, renderers=renderers)
    return simulate_drives(scene_folders, out, config, progress, pupil)
