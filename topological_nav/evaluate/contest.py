"""Scenes and contenders in, a folder of rows out, one file a batch of episodes; a contest that was stopped goes on.

OUT/rows/<scene>-<contender>-<digest>-<first episode>.parquet   one row an episode (`evaluation.columns`)
    tracks/<the same>.npz                                       where the robots went
    <scene>.png, summary.md                                     drawn and told at the end

The digest is of everything that decides the rows: scene, episodes, settings, map, networks, policy. Another question
adds files; the same one finds its own and plays what is missing.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import whole_file
from interactive_nav_common.rows import read_rows, write_parquet
from interactive_nav_common.versions import versions
from topological_nav.config import PASSAGE_POLICY, DataConfig, EvaluationConfig, MapConfig
from topological_nav.data.dataset import lens_of
from topological_nav.data.domains import as_seen_from, preset
from topological_nav.drives.driving import LocalPolicy
from topological_nav.errors import RunError
from topological_nav.evaluate.evaluation import (
    Contender,
    Journeys,
    NavigatorPlayer,
    columns,
    count_of,
    draw_journeys,
    expert,
    learned,
    play,
)
from topological_nav.learn.training import Trained, load_trained
from topological_nav.maps.build import camera_of, drawn_for, renderer_of, true_map
from topological_nav.maps.graph import TopologicalMap, load_map
from topological_nav.maps.sight import NetworkSight, PassagePolicy, Sight, TrueSight
from topological_nav.navigate.navigator import Navigator
from topological_nav.scenes.rooms import find_rooms, recorded_rooms
from topological_nav.scenes.simulation import Camera, Simulator, make_env, pose_camera, scene_camera
from topological_nav.scenes.space import FreeSpace, free_space
from train.runs import checkpoint
from train.runs.run_folder import RunFolder

CONTENDERS = ("dense", "sparse", "expert", "ppo")
"""The navigator on its map, and on the same thinned out; an expert with the plan; a learned policy told the goal."""
NOT_ASKED = ("batch", "episodes", "supersample")
"""Settings that decide no row, or of which it is told otherwise."""
CPU_BATCH = 8
"""Episodes played at a time on a CPU unless asked otherwise."""
Tell = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Contest:
    """Who plays what."""

    scenes: tuple[Path, ...]
    contenders: tuple[str, ...]
    out: Path
    config: EvaluationConfig
    truth: bool = False
    """Maps made from the plan, and the truth in the place of localiser and passage detector."""
    maps: Path = Path()
    """Folder of the scenes' maps, unless `truth`."""
    map_files: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    """Name of a scene -> its map, where that lies elsewhere."""
    localiser: Path = Path()
    detector: Path = Path()
    policy: str = PASSAGE_POLICY
    """The local policy: passage, or a run folder."""
    ppo: Path | None = None
    """Run folder of `python -m train`."""
    robot: str = "ttbot"
    domain: str = "clean"
    """The camera that the navigator sees by, goals included: a name of `domains.PRESETS`."""

    def __post_init__(self) -> None:
        for name in self.contenders:
            if name not in CONTENDERS:
                raise ConfigError(f"contender is '{name}', expected a choice from {', '.join(CONTENDERS)}")
        if "ppo" in self.contenders and self.ppo is None:
            raise ConfigError("contender ppo needs the run folder of a trained policy: --ppo RUN")
        if preset(self.domain) != preset("clean") and self.truth:
            raise ConfigError(f"--domain {self.domain} is of images, --truth has none; leave one of them out")
        names = [Path(s).resolve().name for s in self.scenes]
        if len(set(names)) < len(names):
            raise ConfigError(f"scenes are {', '.join(names)}, expected different names")


@dataclasses.dataclass(frozen=True)
class Networks:
    """What the navigator sees by."""

    localiser: Trained
    detector: Trained
    camera: DataConfig


def load_networks(localiser: Path, detector: Path) -> Networks:
    """The networks of two finished runs.

    Raises:
        RunError: a run is not finished.
        MapError: they learned from different cameras, or the second judges no passages.
    """
    pair = load_trained(localiser), load_trained(detector)
    return Networks(*pair, camera_of(*pair))


class Venue:
    """One scene of a contest; what is costly is made when it is first asked for."""

    def __init__(self, folder: Path, contest: Contest, networks: Networks | None):
        self.contest, self.networks = contest, networks
        self.scene: Scene = load_scene(folder)
        self.robot = get_robot(contest.robot)

    @functools.cached_property
    def space(self) -> FreeSpace:
        """Free space for the robot."""
        return free_space(self.scene, self.robot.height_m)

    @functools.cached_property
    def rooms(self):
        """By the default way of clustering, so that episodes do not depend on networks."""
        data, known = DataConfig(), recorded_rooms(self.scene.digest)
        return find_rooms(self.space, data.room_method, data.num_rooms, known, data.seed, data.clearance_m)

    @functools.cached_property
    def journeys(self) -> Journeys:
        """All episodes of the scene."""
        config = self.contest.config
        return draw_journeys(self.scene.digest, self.space, self.rooms, count_of(self.scene, config), config)

    @functools.cached_property
    def simulator(self) -> Simulator:
        """Of the navigator."""
        return Simulator(make_env(self.scene, self.contest.robot, self.contest.config.backend))

    @functools.cached_property
    def expert_simulator(self) -> Simulator:
        """Of the expert, which plans for half of the robot's width: doorways are narrower than its diagonal."""
        radius_m = self.robot.body_width_m / 2
        return Simulator(make_env(self.scene, self.contest.robot, self.contest.config.backend, radius_m))

    @functools.cached_property
    def map(self) -> TopologicalMap:
        """The dense map."""
        if self.networks is None:
            return true_map(self.scene, self.space, self.rooms, MapConfig(), DataConfig())
        path = self.contest.map_files.get(self.scene.name) or self.contest.maps / f"{self.scene.name}.npz"
        return load_map(path, self.scene.digest)

    @functools.cached_property
    def camera(self) -> Camera:
        """What the navigator's sight understands."""
        if self.networks is None:
            return pose_camera
        plain = scene_camera(renderer_of(self.scene, self.drawn), self.robot)
        domain = preset(self.contest.domain)
        return lambda xy, yaw: as_seen_from(plain(xy, yaw), domain, xy, yaw)

    @property
    def drawn(self) -> DataConfig:
        """How the navigator's images are drawn: as the networks learned, by the map's engine and lens."""
        assert self.networks is not None
        of_map = {k: v for k, v in self.map.about.get("data", {}).items() if k in ("engine", "fov_deg")}
        drawn = overlay(self.networks.camera, of_map, "map")
        drawn = dataclasses.replace(drawn, fov_deg=lens_of(drawn, self.robot).fov_deg)
        return drawn_for(drawn, self.contest.config.supersample)

    def map_of(self, contender: str) -> TopologicalMap:
        """The map that a navigator goes by."""
        if contender != "sparse":
            return self.map
        return self.map.thinned(self.contest.config.thinned, self.contest.config.seed)

    def sight(self, made: TopologicalMap) -> Sight:
        """Networks, or the truth."""
        if self.networks is None:
            return TrueSight(made, self.space)
        return NetworkSight(made, self.networks.localiser, self.networks.detector, self.contest.config.match)

    def navigator(self, contender: str) -> Navigator:
        """Of the dense or the sparse map."""
        made = self.map_of(contender)
        sight = self.sight(made)
        return Navigator(made, sight, local_policy(self.contest, sight, self.networks), self.contest.config)

    def contender(self, name: str) -> tuple[Contender, Simulator]:
        """Who plays, and in what."""
        config = self.contest.config
        if name == "expert":
            return expert(self.expert_simulator, config), self.expert_simulator
        if name == "ppo":
            assert self.contest.ppo is not None
            simulator, policy = _learned(self.contest.ppo, self.scene, config)
            return learned(simulator, policy, config), simulator
        return NavigatorPlayer(self.navigator(name), self.simulator, self.camera, config), self.simulator

    def asked(self, contender: str) -> dict[str, Any]:
        """Everything that decides the rows of a contender."""
        config = {k: v for k, v in to_dict(self.contest.config).items() if k not in NOT_ASKED}
        asked = {"scene": self.scene.digest, "robot": self.contest.robot, "contender": contender, "settings": config}
        if contender == "ppo":
            assert self.contest.ppo is not None
            path, meta = checkpoint.find(RunFolder(self.contest.ppo).checkpoints, "best")
            weights = checkpoint.weights_digest(path)
            return {**asked, "robot": meta.robot, "checkpoint": [meta.env_steps, weights]}
        if contender == "expert":
            return asked
        made = self.map
        parts = [made.xy_w, made.embeddings, made.edges, made.p, made.angle_rad]
        asked["map"] = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()
        if self.networks is not None:
            asked["detector"] = self.networks.detector.stored
            if "export" in self.networks.localiser.about:
                asked["localiser"] = self.networks.localiser.stored
            if self.contest.domain != "clean":
                asked["domain"] = to_dict(preset(self.contest.domain))
            drawn, learned_from = self.drawn, self.networks.camera
            if drawn != learned_from:
                # The size only where it differs, so that rows of before it could be chosen are found.
                size = [drawn.supersample] if drawn.supersample != learned_from.supersample else []
                asked["drawn"] = [drawn.engine, drawn.fov_deg, *size]
        return {**asked, "policy": self.contest.policy, "weights": _digest_of(self.contest.policy)}


def local_policy(contest: Contest, sight: Sight, networks: Networks | None) -> LocalPolicy:
    """What drives along edges; a trained policy sees through adapted networks where the navigator does.

    Raises:
        RunError: no such run.
        ConfigError: a trained policy cannot look at poses.
    """
    if contest.policy == PASSAGE_POLICY:
        return PassagePolicy(sight, contest.config.passable, contest.config.clear_m)
    if contest.truth:
        raise ConfigError(f"--policy {contest.policy} looks at images, --truth has none; leave one of them out")
    from topological_nav.drives import driving

    assert networks is not None
    seeing = (contest.localiser, networks.localiser), (contest.detector, networks.detector)
    return driving.load_policy_beside(contest.policy, *seeing)


def _digest_of(policy: str) -> str:
    """Of a policy's run folder's weights, '' for the baseline."""
    if policy == PASSAGE_POLICY:
        return ""
    files = sorted(
        p for p in Path(policy).glob("*") if p.suffix in (".msgpack", ".xz", ".npz", ".json") and "check" not in p.name
    )
    if not files:
        raise RunError(f"{policy}: holds no trained policy; name the run folder of one, or {PASSAGE_POLICY}")
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()


def _learned(run: Path, scene: Scene, config: EvaluationConfig) -> tuple[Simulator, Any]:
    from train.evaluate import load_policy
    from train.runs.run import make_env as make_trained_env

    folder = RunFolder(run)
    made = folder.read_config()
    backend = made.env.backend if config.backend == "auto" else config.backend
    env_config = dataclasses.replace(made.env, scenes=(str(scene.path),), backend=backend)
    env = make_trained_env(env_config)
    policy, _ = load_policy(folder, dataclasses.replace(made, env=env_config), env, "best", deterministic=False)
    return Simulator(env), policy


def venues_of(contest: Contest) -> list[Venue]:
    """The scenes, with the networks where somebody looks through them.

    Raises:
        TopologicalError, SceneError: something cannot be used.
    """
    navigates = not contest.truth and {"dense", "sparse"} & set(contest.contenders)
    networks = load_networks(contest.localiser, contest.detector) if navigates else None
    return [Venue(folder, contest, networks) for folder in contest.scenes]


def hold(contest: Contest, venues: Sequence[Venue], tell: Tell = lambda *_: None) -> pa.Table:
    """Plays what is missing, and returns all rows.

    Args:
        contest: who plays what.
        venues: of `venues_of`.
        tell: told who plays where, episodes over and episodes in all, after every control step; may raise to stop,
            which loses the batch that is being played.

    Raises:
        TopologicalError, SceneError, TrainError: something cannot be used.
    """
    # Everything that can be refused is refused before the first episode.
    plan = [(venue, name, _stem(venue, name)) for venue in venues for name in contest.contenders]
    missing = [_missing(contest.out, stem, len(venue.journeys)) for venue, _, stem in plan]
    total = sum(len(venue.journeys) for venue, _, _ in plan)
    done = total - sum(map(len, missing))
    cpu = jax.default_backend() == "cpu"
    for (venue, name, stem), numbers in zip(plan, missing, strict=True):
        if not len(numbers):
            continue
        contender, simulator = venue.contender(name)
        size = contest.config.batch or (CPU_BATCH if cpu else len(numbers))
        for first in range(0, len(numbers), size):
            rows = numbers[first : first + size]
            told = functools.partial(_tell, tell, f"{venue.scene.name} {name}", done, total)
            _play(venue, contest.out, name, stem, contender, simulator, rows, told)
            done += len(rows)
            tell(f"{venue.scene.name} {name}", done, total)
    return pa.concat_tables([_rows(contest.out, stem, len(venue.journeys)) for venue, _, stem in plan])


def _tell(tell: Tell, what: str, before: int, total: int, over: int, _: float) -> None:
    tell(what, min(before + over, total - 1), total)


def _stem(venue: Venue, contender: str) -> str:
    asked = json.dumps(venue.asked(contender), sort_keys=True)
    return f"{venue.scene.name}-{contender}-{hashlib.sha256(asked.encode()).hexdigest()[:8]}"


def _files(out: Path, stem: str) -> list[Path]:
    return sorted((out / "rows").glob(f"{stem}-*.parquet"))


def _missing(out: Path, stem: str, count: int) -> np.ndarray:
    """Numbers of the episodes that no file has."""
    there = _rows(out, stem, count)["episode"].to_numpy() if _files(out, stem) else np.zeros(0, int)
    return np.setdiff1d(np.arange(count), there)


def _rows(out: Path, stem: str, count: int) -> pa.Table:
    """Rows of the first `count` episodes: the files may have more, of a time when more were asked for."""
    rows = read_rows(_files(out, stem)).sort_by("episode")
    return rows.filter(pa.array(rows["episode"].to_numpy() < count))


def _play(
    venue: Venue,
    out: Path,
    name: str,
    stem: str,
    contender: Contender,
    simulator: Simulator,
    rows: np.ndarray,
    tell: Callable[[int, float], None],
) -> None:
    config = venue.contest.config
    journeys = venue.journeys.take(rows)
    began = time.perf_counter()
    played = play(contender, simulator, journeys, config, tell)
    here = versions()
    navigates = name in ("dense", "sparse")
    constants = {
        "contender": name,
        "sight": ("truth" if venue.networks is None else "networks") if navigates else "none",
        "domain": venue.contest.domain if navigates else "none",
        "policy": venue.contest.policy if navigates else name,
        "scene": venue.scene.name,
        "split": venue.scene.split,
        "robot": simulator.env.robot.name,
        "seed": config.seed,
        "backend": simulator.env.backend,
        "device": here["device"]["kind"],
        "commit": here["commit"],
        "wall_s": time.perf_counter() - began,
    }
    table = {key: [value] * len(rows) for key, value in constants.items()}
    table |= {"episode": journeys.number, **columns(journeys, played, config)}
    file = f"{stem}-{rows[0]:04d}"
    tracks = out / "tracks" / f"{file}.npz"
    with whole_file(tracks) as partial, open(partial, "wb") as handle:
        named: dict[str, Any] = {str(n): np.asarray(t, np.float32) for n, t in zip(rows, played.track_w, strict=True)}
        np.savez_compressed(handle, **named)
    # Rows last: an episode counts as played once its row is there.
    notes = {"asked": json.dumps(venue.asked(name)), "versions": json.dumps(here["packages"])}
    write_parquet(pa.table(table), out / "rows" / f"{file}.parquet", notes)


def tracks_of(contest: Contest, venue: Venue, contender: str) -> dict[int, np.ndarray]:
    """Episode number -> [t, 2] m, of what has been played."""
    found: dict[int, np.ndarray] = {}
    for path in sorted((contest.out / "tracks").glob(f"{_stem(venue, contender)}-*.npz")):
        with np.load(path) as stored:
            found |= {int(number): stored[number] for number in stored.files}
    return found
