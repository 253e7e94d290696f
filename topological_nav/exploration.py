"""Build a topological map while the robot drives about an unknown home.

At each stop the robot looks around. The embeddings of its images decide whether it is at a known node or a new one, and
the passage detector which headings are open. It drives a run along an unexplored heading of the nearest node that has
any, until none is left. Odometry is used only for the lengths of edges.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from interactive_nav.task.rollout import HostPolicy, episode_keys
from interactive_nav_common.config import refuse_unused, to_dict
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.jobs.progress import Progress, Stopped, say
from interactive_nav_common.rotations import wrap_angle
from topological_nav.commands import bar, contest_of, keep_map
from topological_nav.config import DataConfig
from topological_nav.data.dataset import headings
from topological_nav.drives.driving import local_policy
from topological_nav.evaluate.contest import ContestScene, contest_scenes
from topological_nav.learn.networks import nearest_turn
from topological_nav.maps.build import Built, edge_scores, judged_by
from topological_nav.maps.graph import TopologicalMap
from topological_nav.navigate.navigator import ARRIVED, DRIVE, TIMED_OUT, Navigator
from topological_nav.scenes.rendering import Snapshot, episode_starts

OPEN_M, CLEAR_M, COVERED_M = 1.5, 0.5, 1.5
"""A heading is open that is free for this length; the baseline policy drives on while the way is free for the second;
floor as near to a node as the third is covered."""
SAME, SAME_M = 0.5, 0.9
"""Largest mean distance of embeddings, or with the truth of places (m), at which a node counts as known."""
APART_RAD = np.deg2rad(20.0) + 1e-6
"""Headings this near to one that was driven along are explored; a run ends where the robot has turned away so far."""
LEG_S = 120.0
"""Longest time to reach a node, to look around, or to turn and drive a run."""
UNUSED = "--maps episodes min_goal_m success_m thinned batch objects goal_images match images runs glance clear_m"


class Explorer(HostPolicy):
    """Drive one robot, and remember nodes, edges and unexplored headings."""

    observes = False

    def __init__(self, venue: ContestScene):
        """Store the scene with its judge of images; the explored map replaces its map."""
        self._venue, self._networks, self._config = venue, venue.networks, venue.contest.config
        data = self._networks.camera if self._networks else DataConfig()
        self._around = headings(data)
        self._about = {"settings": to_dict(self._config), "data": to_dict(data), "made": "while exploring"}
        self._about |= self._networks.digests if self._networks else {}
        dark = np.zeros((len(self._around), data.height, data.width, 3), np.uint8)
        self._unseen = self._networks.localiser.embed(dark) if self._networks else dark[:, 0, 0, :0]
        self._nodes, self._unexplored = [], []
        """Place, images and embeddings of each; and [K] probabilities that its headings are open, 0 once explored."""
        self._edges: dict[tuple[int, int], tuple[float, float]] = {}
        """Nodes from and to -> probability, angle."""
        self._left, self._image, self._seen = None, None, {}
        """Node and heading to be explored, None where the robot but looks about; the last image; those about it."""
        self._how = dataclasses.replace(self._config, images=len(self._around), limit_s=LEG_S, clear_m=CLEAR_M)
        venue.map = self.graph(ahead=True)
        self._policy = local_policy(venue.contest.policy, venue.sight(venue.map), self._how, self._networks or ())

    def graph(self, ahead: bool = False) -> TopologicalMap:
        """Return the current map; `ahead` adds an unknown node, `OPEN_M` along the heading to explore."""
        xy, embeddings, edges = [n[0] for n in self._nodes], [n[2] for n in self._nodes], dict(self._edges)
        if ahead:
            node, angle = self._left or (-1, 0.0)
            xy.append((xy[node] if xy else 0.0) + OPEN_M * np.array([np.cos(angle), np.sin(angle)]))
            embeddings.append(self._unseen)
            edges |= {(node, len(xy) - 1): (1.0, angle)} if self._left else {}
        scene, (p, angle_rad) = self._venue.scene, np.array(list(edges.values()), np.float32).reshape(-1, 2).T
        nodes = np.array(xy, np.float32), self._venue.rooms.of(np.array(xy)), np.array(embeddings, np.float32)
        pairs = np.array(list(edges), np.int32).reshape(-1, 2)
        return TopologicalMap(scene.name, scene.digest, *nodes, pairs, p, angle_rad, self._about, self._how.metre_cost)

    def act(self, state: Any, episode: np.ndarray, running: np.ndarray, step: int) -> tuple[Any, np.ndarray]:
        """See `HostPolicy`; the batch is one robot."""
        now, env, over = Snapshot.of(state), self._venue.player.env, False
        heading, time_s = now.yaw_rad, step * env.dt
        if not step:
            self._go()
        looks = self._mind.looks[0]
        if self._image is None or self._navigator.looks(self._mind, heading, time_s).any():
            self._image = self._venue.camera(now.xy_w, heading, now.qpos)
        self._mind = mind = self._navigator.step(self._mind, self._image, heading, time_s)
        if mind.looks[0] > looks:
            self._seen = self._seen if looks else {}
            self._seen[int(nearest_turn(heading[0], len(self._around)))] = self._image[0]
        if mind.phase[0] == TIMED_OUT:
            self._left = None
            self._go()
        elif self._left and mind.goal[0] < len(self._nodes):
            if mind.phase[0] == ARRIVED:
                self._go(self._left[0], heading)
        elif mind.localised[0]:
            over = self._stand(now.xy_w[0], mind.evidence[0, :-1] / len(self._around), heading)
        elif self._left and mind.blocked[0]:
            over = self._choose(self._left[0], heading)
        elif self._left and mind.run_started[0]:
            self._left = self._left[0], float(mind.target_rad[0])
        elif self._left and mind.phase[0] == DRIVE and abs(wrap_angle(heading[0] - self._left[1])) > APART_RAD:
            self._go()
        actions = env.robot.drive(self._mind.linear, self._mind.angular, np)
        return np.asarray(actions, np.float32), np.array([over or time_s >= self._config.limit_s])

    def _go(self, here: int = -1, heading: Any = None, goal: int = -1) -> None:
        """Start a leg from a node: to a known one, along a heading to explore, or, without either, looking around."""
        how = self._how if goal >= 0 else dataclasses.replace(self._how, runs=1, glance=False, swings=1)
        graph = self.graph(ahead=goal < 0)
        self._navigator = Navigator(graph, self._venue.sight(graph), self._policy, how)
        self._mind = self._navigator.start(np.array([goal % len(graph.xy_w)]))
        if here >= 0:
            self._mind.node[:] = here
            self._navigator.plan(self._mind, np.array([0]), heading)

    def _stand(self, xy_w: np.ndarray, away: np.ndarray, heading: np.ndarray) -> bool:
        """Match the place to a known node by distances, or add a node; return whether nothing is left to explore."""
        images, sight = np.stack([self._seen[k] for k in sorted(self._seen)]), self._venue.sight(self.graph(ahead=True))
        here = int(away.argmin()) if len(away) and away.min() < (SAME if self._networks else SAME_M) else len(away)
        if here == len(away):
            p = sight.passage(images, OPEN_M)
            embeddings = self._networks.localiser.embed(images) if self._networks else self._unseen
            self._nodes.append((xy_w, images, embeddings))
            self._unexplored.append(p * (p >= self._how.passable))
        if not np.any(self._unexplored[0]) and not away.size:
            raise ConfigError(f"no heading is open for {OPEN_M:g} m at the start; choose another seed or less passable")
        if self._left and self._left[0] != here and (self._left[0], here) not in self._edges:
            node, angle = self._left
            length_m = float(np.linalg.norm(self._nodes[node][0] - self._nodes[here][0]))
            for a, b, turn in ((node, here, angle), (here, node, float(wrap_angle(angle + np.pi)))):
                ahead = self._nodes[a][1][[nearest_turn(np.array(turn), len(self._around))]]
                self._edges[a, b] = float(sight.passage(ahead, length_m)[0]), turn
                self._unexplored[a][np.abs(wrap_angle(self._around - turn)) <= APART_RAD] = 0.0
        return self._choose(here, heading)

    def _choose(self, here: int, heading: np.ndarray) -> bool:
        """Choose the nearest node with a heading to explore; return whether there is none."""
        cost = np.where([p.any() for p in self._unexplored], self.graph().left[:, here], np.inf)
        goal = int(cost.argmin())
        if np.isfinite(cost[goal]):
            self._left = goal, float(self._around[self._unexplored[goal].argmax()])
            self._unexplored[goal][np.abs(wrap_angle(self._around - self._left[1])) <= APART_RAD] = 0.0
            self._go(here, heading, -1 if goal == here else goal)
        return not np.isfinite(cost[goal])

    def play(self, progress: Progress = lambda *_: None) -> None:
        """Explore from a random place; `progress` may raise to stop."""
        env, rng, total = self._venue.player.env, np.random.default_rng([self._config.seed, 23]), self._config.limit_s
        start_w = self._venue.space.sample(rng, 1, self._config.clearance_m)
        starts = episode_starts(start_w, rng.uniform(-np.pi, np.pi, 1), start_w, 0)

        def report(over: int, step: int) -> None:
            what = f"{len(self._nodes)} nodes, {sum(p.any() for p in self._unexplored)} with open headings, seconds"
            progress(what, int(total if over else min(step * env.dt, total - 1)), int(total))

        self._venue.player.rollout(self, episode_keys(self._config.seed, 1), starts, fewest=1, on_progress=report)

    def built(self) -> Built:
        """Return the current map and its scores against the plan."""
        if not self._nodes:
            raise ConfigError(f"limit_s is {self._config.limit_s:g}, expected time to look about; raise it")
        space, graph, data = self._venue.space, self.graph(), DataConfig()
        how = judged_by(self._networks.detector) if self._networks else (data.passage_margin_m, data.passage_points)
        free = space.segment_free(graph.xy_w[graph.edges[:, 0]], graph.xy_w[graph.edges[:, 1]], how[1], how[0])
        floor = space.centres(self._config.clearance_m)
        near = np.linalg.norm(floor[:, None] - graph.xy_w, axis=-1).min(1) < COVERED_M
        scores = {f"free floor within {COVERED_M} m of a node": f"{near.mean():.3f}"}
        return Built(graph, space, free, scores | edge_scores(graph, free, self._how.passable))


def run_explore(arguments: Any) -> None:
    refuse_unused(arguments, UNUSED, "in 'explore'")
    arguments.maps = None if arguments.truth else Path()  # none is read
    (venue,) = contest_scenes(contest_of(arguments, [arguments.scene], ["dense"], arguments.out))
    explorer = Explorer(venue)
    with bar() as report:
        try:
            explorer.play(report)
        except Stopped:
            say("stopped: the map has what was seen so far; the same command starts again")
    keep_map(explorer.built(), arguments.out / f"{venue.scene.name}.npz")
