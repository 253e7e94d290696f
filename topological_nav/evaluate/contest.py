"""Play contenders in the scenes of a contest into a folder of rows; a stopped contest resumes.

OUT/rows/<scene>-<contender>-<digest>-<first episode>.parquet   one row per episode (`evaluation.columns`)
    tracks/<the same>.npz                                       paths of the robots
    <scene>.png, summary.md                                     written at the end

The digest covers everything that determines the rows: scene, episodes, settings, map, networks, policy. A contest with
the same digest reads its files and plays only missing episodes.
"""

import dataclasses
import functools
import hashlib
import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow as pa

from interactive_nav import get_robot, load_scene
from interactive_nav.robots import RobotSpec
from interactive_nav.scenes.scene import Scene
from interactive_nav.task.rollout import Player
from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import ConfigError, FileError
from interactive_nav_common.files import write_arrays
from interactive_nav_common.jobs.progress import Progress, SafeConsole
from interactive_nav_common.rows import Columns, digest_of, read_rows, write_parquet
from interactive_nav_common.untrusted.reading import read_npz
from interactive_nav_common.versions import versions
from topological_nav.config import PASSAGE_POLICY, DataConfig, EvaluationConfig, MapConfig
from topological_nav.data.domains import PRESETS, as_seen_from
from topological_nav.data.folders import lens_of, renderer_of
from topological_nav.drives.driving import local_policy
from topological_nav.evaluate import evaluation
from topological_nav.evaluate.evaluation import DrivenEpisodes, Played
from topological_nav.learn.training import Networks, load_networks
from topological_nav.maps.build import NetworkSight, Sight, TrueSight, drawn_for, true_map
from topological_nav.maps.graph import TopologicalMap, load_map
from topological_nav.navigate.navigator import Navigator
from topological_nav.scenes.rendering import CONTROL, Camera, make_env, scene_camera
from topological_nav.scenes.space import FreeSpace, free_space, scene_rooms
from train.runs import checkpoint
from train.runs.run_folder import RunFolder
from train.scoring.policies import Planner

CONTENDERS = ("dense", "sparse", "expert", "ppo")
"""The navigator on its map and on a thinned one; an expert with the plan; a policy that observes the goal."""
EXPERT_WEIGHT = 1.0
"""Weight of path against effort: objects are pushed only where no path is free."""
FILM_HEIGHT = 480
"""Height of a film in pixels."""
UNDECIDING = ("batch", "episodes", "supersample")
"""Settings that do not affect rows, or enter the digest in another form."""


@dataclasses.dataclass(frozen=True)
class Contest:
    """Set the players and the scenes."""

    scenes: tuple[Path, ...]
    contenders: tuple[str, ...]
    out: Path
    config: EvaluationConfig
    truth: bool = False
    """Use maps built from the plan, and the truth instead of localiser and passage detector."""
    maps: Path = Path()
    """Folder of the scenes' maps, unless `truth`."""
    map_files: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    """Name of a scene -> its map, if it lies elsewhere."""
    localiser: Path = Path()
    detector: Path = Path()
    policy: str = PASSAGE_POLICY
    """The local policy: passage, or a run folder."""
    ppo: Path | None = None
    """Run folder of `python -m train`."""
    robot: str = "ttbot"
    domain: str = "clean"
    """Camera of the navigator, goals included: a name of `domains.PRESETS`."""
    preset: str = "default"
    """Preset under the settings; rows name it."""

    def __post_init__(self) -> None:
        for name in self.contenders:
            if name not in CONTENDERS:
                raise ConfigError(f"contender is '{name}', expected a choice from {', '.join(CONTENDERS)}")
        if len(set(self.contenders)) < len(self.contenders):
            raise ConfigError(f"contenders are {', '.join(self.contenders)}, expected each once")
        if self.config.blocked and not self.config.objects:
            raise ConfigError("blocked=true needs a small object to block the way with; set objects=1 or more")
        if "ppo" in self.contenders and self.ppo is None:
            raise ConfigError("contender ppo needs the run folder of a trained policy: --ppo RUN")
        if PRESETS[self.domain] != PRESETS["clean"] and self.truth:
            raise ConfigError(f"--domain {self.domain} is of images, --truth has none; leave one of them out")
        names = [Path(s).resolve().name for s in self.scenes]
        if len(set(names)) < len(names):
            raise ConfigError(f"scenes are {', '.join(names)}, expected different names")


class ContestScene:
    """Hold one scene of a contest; costly parts are built at their first use."""

    def __init__(self, folder: Path, contest: Contest, networks: Networks | None):
        self.contest, self.networks = contest, networks
        self.scene: Scene = load_scene(folder)
        self.robot = get_robot(contest.robot)

    @functools.cached_property
    def space(self) -> FreeSpace:
        return free_space(self.scene, self.robot.height_m)

    @functools.cached_property
    def rooms(self):
        """Cluster by the default settings, so that episodes do not depend on networks."""
        return scene_rooms(self.scene, self.space, DataConfig())

    @functools.cached_property
    def episodes(self) -> DrivenEpisodes:
        config = self.contest.config
        count = evaluation.count_of(self.scene, config)
        return evaluation.draw_episodes(self.scene.digest, self.space, self.rooms, count, config)

    @functools.cached_property
    def player(self) -> Player:
        """Return a player of episodes with the navigator."""
        return self._player(get_robot(self.contest.robot, CONTROL))

    def _player(self, robot: RobotSpec) -> Player:
        settings = {"num_objects": self.contest.config.objects, "observations": ("localisation",)}
        return Player(make_env([self.scene.path], robot, self.contest.config.backend, **settings), {})

    @functools.cached_property
    def map(self) -> TopologicalMap:
        if self.networks is None:
            return true_map(self.scene, self.space, self.rooms, MapConfig(), DataConfig())
        path = self.contest.map_files.get(self.scene.name) or self.contest.maps / f"{self.scene.name}.npz"
        return load_map(path, self.scene.digest)

    @functools.cached_property
    def camera(self) -> Camera:
        """Return the camera for the navigator's sight."""
        if self.networks is None:
            return lambda xy_w, yaw_rad, _=None: np.column_stack([xy_w, yaw_rad])  # what `TrueSight` looks at
        return self._camera(self.drawn)

    @functools.cached_property
    def film_camera(self) -> Camera | None:
        """Return the camera for films, with as many pixels; with a domain the navigator's, as its blur is in pixels."""
        if self.networks is None:
            return None
        if self.contest.domain != "clean":
            return self.camera
        drawn = self.drawn
        by = math.ceil(FILM_HEIGHT / drawn.height)
        larger = {"width": by * drawn.width, "height": by * drawn.height, "supersample": 2}
        return self._camera(dataclasses.replace(drawn, **larger))

    def _camera(self, drawn: DataConfig) -> Camera:
        world = self.player.env.world
        plain = scene_camera(renderer_of(self.scene, drawn, world.small_objects), self.robot, world)
        domain = PRESETS[self.contest.domain]
        return lambda xy, yaw, qpos=None: as_seen_from(plain(xy, yaw, qpos), domain, xy, yaw)

    @property
    def drawn(self) -> DataConfig:
        """Return the navigator's image settings: as in training, with the map's engine and lens."""
        assert self.networks is not None
        of_map = {k: v for k, v in self.map.about.get("data", {}).items() if k in ("engine", "fov_deg")}
        drawn = overlay(self.networks.camera, of_map, "map")
        drawn = dataclasses.replace(drawn, fov_deg=lens_of(drawn, self.robot).fov_deg)
        return drawn_for(drawn, self.contest.config.supersample)

    def map_of(self, contender: str) -> TopologicalMap:
        if contender != "sparse":
            return self.map
        return self.map.thinned(self.contest.config.thinned, self.contest.config.seed)

    def sight(self, graph: TopologicalMap) -> Sight:
        """Return the networks, or the truth."""
        if self.networks is None:
            return TrueSight(graph, self.space)
        return NetworkSight(graph, self.networks, self.contest.config.match)

    def navigator(self, contender: str) -> Navigator:
        graph = self.map_of(contender)
        sight = self.sight(graph)
        name, config = self.contest.policy, self.contest.config
        if self.contest.truth and name != PASSAGE_POLICY:
            raise ConfigError(f"--policy {name} looks at images, --truth has none; leave one of them out")
        return Navigator(graph, sight, local_policy(name, sight, config, self.networks or ()), config)

    def contender(self, name: str) -> evaluation.Contender:
        """Return the contender of a name, ready to play."""
        config = self.contest.config
        if name == "expert":
            # It plans for half of the robot's width: doorways are narrower than its diagonal, and ways that join
            # episodes are 0.25 m from everything. Where no way is free, it takes the one through the least of objects.
            robot = get_robot(self.contest.robot, CONTROL)
            player = self._player(dataclasses.replace(robot, footprint_radius_m=robot.body_width_m / 2))
            return evaluation.ActionPlayer(player, config, lambda: Planner(player.env, EXPERT_WEIGHT).act)
        if name == "ppo":
            assert self.contest.ppo is not None
            player, policy = _learned(self.contest.ppo, self.scene, config)
            return evaluation.learned(player, config, policy)
        return evaluation.NavigatorPlayer(self.player, config, self.navigator(name), self.camera)

    def request(self, contender: str) -> dict[str, Any]:
        """Return everything that determines a contender's rows."""
        config = {k: v for k, v in to_dict(self.contest.config).items() if k not in UNDECIDING}
        request = {"scene": self.scene.digest, "robot": self.contest.robot, "contender": contender, "settings": config}
        if contender == "ppo":
            assert self.contest.ppo is not None
            path, meta = checkpoint.find(RunFolder(self.contest.ppo).checkpoints, "best")
            weights = checkpoint.weights_digest(path)
            return {**request, "robot": meta.robot, "checkpoint": [meta.env_steps, weights]}
        if contender == "expert":
            return request
        graph = self.map
        parts = [graph.xy_w, graph.embeddings, graph.edges, graph.p, graph.angle_rad]
        request["map"] = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest()
        if self.networks is not None:
            request["networks"] = [network.stored for network in self.networks]
            request["domain"] = to_dict(PRESETS[self.contest.domain])
            request["drawn"] = [self.drawn.engine, self.drawn.fov_deg, self.drawn.supersample]
        return {**request, "policy": self.contest.policy, "weights": _digest_of(self.contest.policy)}


def _digest_of(policy: str) -> str:
    """Return the digest of a policy's weights, '' for the baseline."""
    if policy == PASSAGE_POLICY:
        return ""
    files = sorted(
        p for p in Path(policy).glob("*") if p.suffix in (".safetensors", ".xz", ".json") and "check" not in p.name
    )
    if not files:
        raise FileError(f"{policy}: holds no trained policy; name the run folder of one, or {PASSAGE_POLICY}")
    return hashlib.sha256(b"".join(p.read_bytes() for p in files)).hexdigest()


def _learned(run: Path, scene: Scene, config: EvaluationConfig) -> tuple[Player, Any]:
    from train.runs.run import build_env, config_to_play
    from train.scoring.evaluation import load_policy

    folder, words = RunFolder(run), [f"env.backend={config.backend}"] if config.backend != "auto" else []
    words += [f"env.num_objects={config.objects}"] if config.objects else []
    played = config_to_play(folder, words, [str(scene.path)], SafeConsole(stderr=True))
    env = build_env(played.env)
    policy, _ = load_policy(folder, played, env, "best", deterministic=False)
    return Player(env, {}), policy


def contest_scenes(contest: Contest) -> list[ContestScene]:
    """Return the scenes, with networks if a contender uses them."""
    navigates = not contest.truth and {"dense", "sparse"} & set(contest.contenders)
    networks = None
    if navigates:
        networks = load_networks(contest.localiser, contest.detector).asking(contest.config.asked_m)
    return [ContestScene(folder, contest, networks) for folder in contest.scenes]


CPU_BATCH = 8
"""Default number of episodes to play at a time on a CPU."""


def play_contest(contest: Contest, scenes: Sequence[ContestScene], on_progress: Progress = lambda *_: None) -> pa.Table:
    """Play missing episodes and return all rows."""
    # Everything that can be refused is refused before the first episode.
    plan = [(scene, name, _stem(scene, name)) for scene in scenes for name in contest.contenders]
    missing = [_missing(contest.out, stem, len(scene.episodes)) for scene, _, stem in plan]
    total = sum(len(scene.episodes) for scene, _, _ in plan)
    done = total - sum(map(len, missing))
    cpu = jax.default_backend() == "cpu"
    for (scene, name, _), numbers in zip(plan, missing, strict=True):
        if not len(numbers):
            continue
        contender = scene.contender(name)
        size = contest.config.batch or (CPU_BATCH if cpu else len(numbers))
        for first in range(0, len(numbers), size):
            rows = numbers[first : first + size]
            what, before = f"{scene.scene.name} {name}", done

            def report(over: int, _: float, what: str = what, before: int = before) -> None:
                on_progress(what, min(before + over, total - 1), total)

            episodes, began = scene.episodes.take(rows), time.perf_counter()
            played = contender.play(episodes, report)
            _write(contest, scene, name, contender.player.env, episodes, played, time.perf_counter() - began)
            done += len(rows)
            on_progress(what, done, total)
    return pa.concat_tables([_rows(contest.out, stem, len(scene.episodes)) for scene, _, stem in plan])


COLUMNS = Columns(
    text=("contender", "sight", "domain", "policy", "scene", "split"),
    whole=("episode", "runs", "contact_runs"),
    numbers=("success", "spl", "within", "contact", "aadc_s", "contact_s", "duration_s", "path_m", "goal_m"),
)


def _stem(scene: ContestScene, contender: str) -> str:
    return f"{scene.scene.name}-{contender}-{digest_of(scene.request(contender))}"


def _missing(out: Path, stem: str, count: int) -> np.ndarray:
    """Return the numbers of the episodes that are in no file."""
    some = any((out / "rows").glob(f"{stem}-*.parquet"))
    return np.setdiff1d(np.arange(count), _rows(out, stem, count)["episode"].to_numpy() if some else [])


def _rows(out: Path, stem: str, count: int) -> pa.Table:
    """Return the rows of the first `count` episodes, for duplicates the first in the files."""
    rows = read_rows(list((out / "rows").glob(f"{stem}-*.parquet")), COLUMNS.check)
    number, first = np.unique(rows["episode"].to_numpy(), return_index=True)
    return rows.take(first[number < count])


def _write(
    contest: Contest, scene: ContestScene, name: str, env: Any, episodes: DrivenEpisodes, played: Played, wall_s: float
) -> None:
    config, out, here = contest.config, contest.out, versions()
    navigates = name in ("dense", "sparse")
    constants = {
        "contender": name,
        "sight": ("truth" if scene.networks is None else "networks") if navigates else "none",
        "domain": scene.contest.domain if navigates else "none",
        "policy": scene.contest.policy if navigates else name,
        "preset": scene.contest.preset,
        "scene": scene.scene.name,
        "split": scene.scene.split,
        "robot": env.robot.name,
        "seed": config.seed,
        "backend": env.backend,
        "device": here["device"]["kind"],
        "commit": here["commit"],
        "wall_s": wall_s,
    }
    table = {key: [value] * len(episodes) for key, value in constants.items()}
    table |= {"episode": episodes.number, **evaluation.columns(episodes, played, config)}
    file = f"{_stem(scene, name)}-{episodes.number[0]:04d}"
    tracks = {str(n): np.asarray(t, np.float32) for n, t in zip(episodes.number, played.track_w, strict=True)}
    write_arrays(out / "tracks" / f"{file}.npz", **tracks)
    # Rows last: an episode counts as played once its row is there.
    notes = {"asked": json.dumps(scene.request(name)), "versions": json.dumps(here["packages"])}
    write_parquet(pa.table(table), out / "rows" / f"{file}.parquet", notes)


def tracks_of(contest: Contest, scene: ContestScene, contender: str) -> dict[int, np.ndarray]:
    """Return episode number -> path [t, 2] m, of the episodes played so far."""
    tracks: dict[int, np.ndarray] = {}
    for path in sorted((contest.out / "tracks").glob(f"{_stem(scene, contender)}-*.npz")):
        with read_npz(path, FileError, "delete it and evaluate again") as stored:
            tracks = {int(number): stored[number] for number in stored.files} | tracks
    return tracks
