"""Export finished runs as a small folder, and choose networks, policy and maps that are not named.

OUT/rooms/ passages/ policy/   weights.safetensors.xz, network.json, config.yaml, versions.json, results.json
    maps/SCENE.npz             embeddings in half precision
    export.json                commit, device and digest of each run, agreement of the networks with the runs

Kernels and matrices are fp16; biases, scales and statistics stay f32, because a variance may overflow fp16. `digest` in
network.json is that of the run, so that maps and policies fit both. Exports whose predictions differ are refused.
The package contains such a folder, `weights/exported`; its policy and maps are optional.
"""

import dataclasses
import importlib.resources
import os
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from interactive_nav import get_robot, load_scene
from interactive_nav_common.errors import ConfigError, FileError, typed
from interactive_nav_common.files import whole_folder, write_json
from interactive_nav_common.jobs.progress import Progress, say
from interactive_nav_common.records import Reader
from interactive_nav_common.runs.folder import CONFIG, VERSIONS
from interactive_nav_common.runs.weights import half, read_weights
from interactive_nav_common.versions import versions
from topological_nav.config import PASSAGE_POLICY, RUNS, ExportConfig
from topological_nav.data.dataset import headings, load_rooms
from topological_nav.drives.driving import TrainedPolicy, load_policy
from topological_nav.learn import learning
from topological_nav.learn.training import Networks, load_networks, load_trained
from topological_nav.maps.build import Pictures
from topological_nav.maps.graph import load_map, save_map
from topological_nav.scenes.space import free_space

FORMAT, PRECISION, ABOUT = 1, "fp16", "export.json"


def export(
    localiser: Path,
    detector: Path,
    policy: Path | None,
    maps: Path | None,
    images: Path,
    out: Path,
    config: ExportConfig,
    progress: Progress = lambda *_: None,
) -> dict[str, float]:
    """Write an export atomically, replacing one at `out`; return the comparison."""
    out = Path(os.path.abspath(out))
    if out.exists() and not (out / ABOUT).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise FileError(f"{out}: is something else than an export; choose another folder (-o)")
    runs = {"rooms": localiser, "passages": detector} | ({"policy": policy} if policy else {})
    files = sorted(maps.glob("*.npz")) if maps else []
    if maps and not files:
        again = f"python -m topological_nav map SCENE -o {typed(maps / 'SCENE.npz')}"
        raise FileError(f"{maps}: holds no map; make some: {again}")
    networks = load_networks(runs["rooms"], runs["passages"], classifies=True)
    driver = load_policy(policy, localiser, detector) if policy else None
    pictures = level_images(images, networks, config.places, progress)
    total = len(runs) + len(files) + 1
    with whole_folder(out, overwrite=True) as part:
        about: dict[str, Any] = {"format": FORMAT, "precision": PRECISION, "networks": {}, "maps": {}}
        for done, (task, run) in enumerate(runs.items()):
            progress(task, done, total)
            about["networks"][task] = _export_run(task, run, part / task, config)
        for done, path in enumerate(files, len(runs)):
            progress(path.stem, done, total)
            built = load_map(path)
            for name, digest in networks.digests.items():
                if built.about.get(name) != digest:
                    raise FileError(f"{path}: was built with another {name}; build the map again with the exported one")
            halved = dataclasses.replace(built, embeddings=built.embeddings.astype(np.float16))
            save_map(halved, part / "maps" / path.name)
            facts = {"scene_digest": built.digest, "nodes": len(built.xy_w), "edges": len(built.edges)}
            about["maps"][path.stem] = facts
        progress("comparing", total - 1, total)
        exported = Networks(load_trained(part / "rooms"), load_trained(part / "passages"))
        compared = compare(networks, exported, driver, load_policy(part / "policy") if driver else None, pictures)
        for name in ("largest_embedding_distance", "largest_probability_difference"):
            if not compared[name] <= config.tolerance:
                raise FileError(
                    f"{PRECISION} changes the predictions: {name} is {compared[name]:.2g}, expected at most "
                    f"{config.tolerance:g} (tolerance)"
                )
        about |= {"compared": compared, "exported_by": {"commit": versions()["commit"]}}
        write_json(part / ABOUT, about)
    progress("comparing", total, total)
    return compared


def compare(
    networks: Networks,
    exported: Networks,
    driver: TrainedPolicy | None,
    exported_driver: TrainedPolicy | None,
    images: np.ndarray,
) -> dict[str, float]:
    """Compare runs with exports by images [P, K, H, W, 3] u8; policies see each place's images one after the other."""
    flat = images.reshape(-1, *images.shape[2:])
    before, after = ([net.embed(flat) for net in pair] for pair in (networks, exported))
    embedding = np.stack([np.linalg.norm(a - b, axis=-1) for a, b in zip(before, after, strict=True)])
    logits = [pair.detector.logits(flat).astype(float) for pair in (networks, exported)]
    probability = 1.0 / (1.0 + np.exp(-np.stack(logits)))
    rooms = [pair.localiser.logits(flat).argmax(-1) for pair in (networks, exported)]
    scores = {
        "images": len(flat),
        "largest_embedding_distance": float(embedding.max()),
        "mean_embedding_distance": float(embedding.mean()),
        "largest_probability_difference": float(np.abs(probability[0] - probability[1]).max()),
        "same_passage": float(((probability[0] > 0.5) == (probability[1] > 0.5)).mean()),
        "same_room": float((rooms[0] == rooms[1]).mean()),
    }
    if driver is not None and exported_driver is not None:
        driven = [_driven(one, images) for one in (driver, exported_driver)]
        same = (driven[0] == driven[1]).mean((0, 2))
        scores |= {"same_linear": float(same[0]), "same_angular": float(same[1])}
    return scores


def level_images(source: Path, networks: Networks, places: int, progress: Progress = lambda *_: None) -> np.ndarray:
    """Return level images [P, K, H, W, 3] u8 around places of a dataset, or of a scene, which is rendered."""
    if (source / "dataset.json").is_file():
        images = load_rooms(source, ["level"]).images[:, 0]
        return images[np.unique(np.linspace(0, len(images) - 1, places).round().astype(int))]
    if not (source / "scene.json").is_file():
        raise ConfigError(f"{source}: is no dataset or scene whose images to compare by; name one: --images PATH")
    data, scene = networks.camera, load_scene(source)
    robot = get_robot(data.robot)
    xy = free_space(scene, robot.height_m).sample(np.random.default_rng([0, 19]), places, data.clearance_m)
    return Pictures(scene, data, robot, progress).draw_around(xy, headings(data), scene.name)


def _driven(policy: TrainedPolicy, images: np.ndarray) -> np.ndarray:
    """Return the velocities [K, 2, P] that a policy commands in K steps."""
    state, velocities = policy.start(len(images)), []
    for step in range(images.shape[1]):
        state, *velocity = policy.act(state, images[:, step])
        velocities.append(velocity)
    return np.array(velocities)


def _export_run(task: str, run: Path, out: Path, config: ExportConfig) -> dict[str, Any]:
    """Write a run's folder and return its commit, device and command."""
    for name in (CONFIG, VERSIONS, learning.RESULTS):
        if not (run / name).is_file():
            raise FileError(f"{run}: has no {name}; finish the run first")
    reader = Reader(FileError, "finish the run first", finite=False)
    origin = reader.typed(reader.json(run / VERSIONS), dict[str, Any], f"{run / VERSIONS}")
    origin["commit"] = origin.get("commit") or config.commit
    origin["argv"] = [_without_folder(word) for word in origin.get("argv", [])]
    device = reader.typed(origin.get("device", {}), dict[str, Any], f"{run / VERSIONS}: device").get("kind")
    if not origin["commit"] or not device:
        raise FileError(f"{run}: {VERSIONS} names no {'device' if origin['commit'] else 'commit'}; say commit=HASH")
    about = {**learning.read_description(run, "network", task), "commit": origin["commit"]}
    if task == "policy":
        for network, other in zip(about["networks"], ("rooms", "passages"), strict=True):
            network["run"] = f"../{other}"
    tensors, _ = read_weights(learning.weights_file(run), FileError, "train again")
    learning.write_network(out, half(tensors), about, PRECISION)
    write_json(out / VERSIONS, origin)
    for name in (CONFIG, learning.RESULTS):
        shutil.copyfile(run / name, out / name)
    kept = {name: about[name] for name in ("digest", "parameters", "commit")}
    return {**kept, "device": device, "command": origin["argv"]}


def _without_folder(word: str) -> str:
    """Return a word of a command line, with an absolute path reduced to its file name."""
    key, sign, value = word.rpartition("=")
    return f"{key}{sign}{PurePath(value).name}" if PurePath(value).is_absolute() else word


def packaged_weights() -> Path:
    """Return the folder of weights in the package."""
    return Path(str(importlib.resources.files("topological_nav"))) / "weights" / "exported"


@dataclasses.dataclass(frozen=True)
class Choice:
    """Name the runs and maps to use."""

    localiser: Path
    detector: Path
    policy: str
    """A run folder, or `PASSAGE_POLICY`."""
    maps: tuple[Path, ...]
    """Folders that may contain the scene's map; a new one is written to the first."""
    renewed: bool
    """Whether a map that does not fit may be rebuilt, because only this program writes there."""
    source: str
    """Where the networks come from; empty if the caller named them."""

    def report(self, policy: bool = True) -> None:
        """Print the origin of the networks, and the local policy, unless the caller named the networks."""
        if self.source:
            say(f"{self.source}; local policy: {self.policy}" if policy else self.source)


def choose(
    localiser: Path | None,
    detector: Path | None,
    policy: str | None = None,
    needs: Sequence[str] = ("rooms", "passages"),
) -> Choice:
    """Choose the run folders that are not given.

    Missing networks come from `RUNS` if all are trained there, else from the package. The policy is taken from the same
    place if neither network is given, else it is `PASSAGE_POLICY`.
    """
    given = {"rooms": localiser, "passages": detector}
    missing = [task for task in needs if given[task] is None]
    if not missing:
        runs = localiser or RUNS / "rooms", detector or RUNS / "passages"
        return Choice(*runs, policy or PASSAGE_POLICY, (RUNS / "maps",), False, "")
    packaged = packaged_weights()
    files = [Path(task, learning.DESCRIPTION) for task in missing]
    place = next((p for p in (RUNS, packaged) if all((p / file).is_file() for file in files)), None)
    if place is None:
        what = " and ".join(missing)
        options = " or ".join({"rooms": "--localiser RUN", "passages": "--detector RUN"}[task] for task in missing)
        raise FileError(
            f"no trained networks of {what}: neither {RUNS} nor the installed package has them; train them (python -m "
            f"topological_nav train {missing[0]}) or name a run folder: {options}"
        )
    chosen = {task: run or place / task for task, run in given.items()}
    if policy is None:
        policy = PASSAGE_POLICY
        if not any(given.values()) and (place / "policy" / learning.DESCRIPTION).is_file():
            policy = str(place / "policy")
    if place == RUNS:
        source = f"networks: {' and '.join(str(chosen[task]) for task in missing)}"
        maps, renewed = (RUNS / "maps",), False
    else:
        source = f"networks: {' and '.join(missing)} of the package, {packaged}"
        maps, renewed = (RUNS / "maps-packaged", packaged / "maps"), True
    return Choice(chosen["rooms"], chosen["passages"], policy, maps, renewed, source)


def fitting_map(choice: Choice, scene: str, digest: str) -> Path | None:
    """Return the first map of a scene that these networks can use, or None."""
    runs = choice.localiser, choice.detector
    networks = [learning.read_description(run, "network", "TASK")["digest"] for run in runs]
    for folder in choice.maps:
        path = folder / f"{scene}.npz"
        if path.is_file():
            try:
                about = load_map(path, digest).about
            except FileError:
                continue
            if [about.get(name) for name in ("localiser", "detector")] == networks:
                return path
    return None
