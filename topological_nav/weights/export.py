"""Finished runs in, a small folder out that carries them: weights in half precision, where they came from, maps.

OUT/rooms/ passages/ policy/   weights.safetensors.xz, network.json, config.yaml, versions.json, results.json
    maps/SCENE.npz             embeddings in half precision
    export.json                commit, device and digest of every run, sizes, how well the networks agree with the runs'

Everything that reads a run folder reads these. Kernels and matrices are fp16; biases, scales and statistics, one number
in a hundred, stay f32: a variance may exceed what fp16 holds. `digest` in network.json stays that of the run, so that
maps and policies made with either belong to both: an export whose predictions differ is refused.
`export.weights_digest` is that of the tensors in `weights.safetensors.xz`.
"""

import dataclasses
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import load_scene
from interactive_nav_common.errors import ConfigError
from interactive_nav_common.files import whole_folder, write_text
from interactive_nav_common.records import Reader
from interactive_nav_common.runs import weights
from interactive_nav_common.versions import versions
from topological_nav.config import PITCHES, ExportConfig
from topological_nav.data.dataset import headings, load_rooms
from topological_nav.drives.driving import TrainedPolicy, load_policy
from topological_nav.errors import MapError, Progress, RunError
from topological_nav.learn.runs import CONFIG, DESCRIPTION, PACKED_WEIGHTS, RESULTS, shown, weights_file
from topological_nav.learn.training import SAME, Trained, camera_of, load_pair, load_trained
from topological_nav.maps.build import Pictures
from topological_nav.maps.graph import load_map, save_map
from topological_nav.scenes.space import free_space
from topological_nav.weights.packaged import ABOUT

FORMAT = 1
PRECISION = "fp16"
VERSIONS = "versions.json"


@dataclasses.dataclass(frozen=True)
class Compared:
    """What runs and their exports make of the same images: P places, K headings."""

    embedding: np.ndarray
    """[2, P K] distance between the two embeddings of an image, by the localiser and by the detector."""
    apart: np.ndarray
    """[P K] distance of an image's embedding to the nearest of another place, by the localiser."""
    probability: np.ndarray
    """[2, P K, L] that the way is free for each of the detector's lengths, by the run and by the export."""
    scores: dict[str, float]


@dataclasses.dataclass(frozen=True)
class Exported:
    """What was written."""

    sizes: dict[str, int]
    """Part -> bytes."""
    compared: Compared


def _free_place(out: Path) -> Path:
    out = Path(os.path.abspath(out))
    if out.exists() and not (out / ABOUT).is_file() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out}: is something else than an export; choose another folder (-o)")
    return out


def export(
    localiser: Path,
    detector: Path,
    policy: Path | None,
    maps: Path | None,
    images: Path,
    out: Path,
    config: ExportConfig,
    progress: Progress = lambda *_: None,
) -> Exported:
    """Writes an export, whole or not at all; one that stands at `out` is replaced.

    Args:
        policy: of a local policy that learned with both, or None.
        maps: folder of SCENE.npz, all made with both, or None.
    """
    out = _free_place(out)
    runs = {"rooms": Path(localiser), "passages": Path(detector)} | ({"policy": Path(policy)} if policy else {})
    files = sorted(Path(maps).glob("*.npz")) if maps else []
    if maps and not files:
        raise MapError(f"{maps}: holds no map; make some: python -m topological_nav map SCENE -o {maps}/SCENE.npz")
    networks = load_pair(runs["rooms"], runs["passages"], (*SAME, "headings"))
    driver = load_policy(policy, localiser, detector) if policy else None
    pictures = level_images(images, networks, config.places, progress)
    total = len(runs) + len(files) + 1
    with whole_folder(out, overwrite=True) as made:
        about: dict[str, Any] = {"format": FORMAT, "precision": PRECISION, "networks": {}, "maps": {}}
        for done, (task, run) in enumerate(runs.items()):
            progress(task, done, total)
            about["networks"][task] = _export_run(task, run, made / task, config)
        for done, path in enumerate(files, len(runs)):
            progress(path.stem, done, total)
            about["maps"][path.stem] = _export_map(path, made / "maps" / path.name, networks)
        progress("comparing", total - 1, total)
        exported = load_trained(made / "rooms"), load_trained(made / "passages")
        compared = compare(networks, exported, driver, load_policy(made / "policy") if driver else None, pictures)
        for name in ("largest_embedding_distance", "largest_probability_difference"):
            if not compared.scores[name] <= config.tolerance:
                raise RunError(
                    f"{PRECISION} changes the predictions: {name} is {compared.scores[name]:.2g}, expected at most "
                    f"{config.tolerance:g} (tolerance)"
                )
        about |= {"compared": compared.scores, "exported_by": {"commit": versions()["commit"]}}
        write_text(made / ABOUT, json.dumps(about, indent=1) + "\n")
        sizes = sizes_of(made)
        if sum(sizes.values()) > config.limit_mib * 2**20:
            raise RunError(f"{out}: {size_lines(sizes, config.limit_mib)}")
    progress("comparing", total, total)
    return Exported(sizes, compared)


def sizes_of(folder: Path) -> dict[str, int]:
    """Bytes of an export by what they are for: weights of each network, maps, descriptions."""
    sizes: Counter[str] = Counter()
    for path in sorted(p for p in Path(folder).rglob("*") if p.is_file()):
        part = path.relative_to(folder).parts[0]
        sizes[part if path.name == PACKED_WEIGHTS or part == "maps" else "descriptions"] += path.stat().st_size
    return dict(sizes)


def size_lines(sizes: dict[str, int], limit_mib: float) -> str:
    """In words, the largest first."""
    parts = sorted(sizes.items(), key=lambda item: -item[1])
    told = ", ".join(f"{name} {size / 2**20:.2f}" for name, size in parts)
    total = sum(sizes.values()) / 2**20
    said = f"{total:.2f} MiB: {told}"
    if total > limit_mib:
        said += (
            f"; expected at most {limit_mib:g} MiB (limit_mib): leave maps out, or train with a smaller width, hidden "
            "or projection"
        )
    return said


def compare(
    networks: tuple[Trained, Trained],
    exported: tuple[Trained, Trained],
    driver: TrainedPolicy | None,
    exported_driver: TrainedPolicy | None,
    images: np.ndarray,
) -> Compared:
    """What runs and exports make of the same images.

    Args:
        driver: the run's policy, or None.
        exported_driver: the export's.
        images: [P, K, H, W, 3] u8; each place's images are also shown to the policies one after the other.
    """
    places, around = images.shape[:2]
    flat = images.reshape(-1, *images.shape[2:])
    before, after = ([net.embed(flat) for net in pair] for pair in (networks, exported))
    embedding = np.stack([np.linalg.norm(a - b, axis=-1) for a, b in zip(before, after, strict=True)])
    logits = [pair[1].logits(flat).astype(float) for pair in (networks, exported)]
    probability = 1.0 / (1.0 + np.exp(-np.stack(logits)))
    rooms = [pair[0].logits(flat).argmax(-1) for pair in (networks, exported)]
    scores = {
        "images": len(flat),
        "largest_embedding_distance": float(embedding.max()),
        "mean_embedding_distance": float(embedding.mean()),
        "largest_probability_difference": float(np.abs(probability[0] - probability[1]).max()),
        "same_passage": float(((probability[0] > 0.5) == (probability[1] > 0.5)).mean()),
        "same_room": float((rooms[0] == rooms[1]).mean()),
    }
    apart = np.zeros(len(flat))
    if places > 1:
        place, own = np.arange(len(flat)) // around, before[0].astype(float)
        far = [
            cdist(one, own) + np.where(place[:, None] == place, np.inf, 0.0) for one in (own, after[0].astype(float))
        ]
        apart = far[0].min(1)
        scores["same_nearest_place"] = float((place[far[0].argmin(1)] == place[far[1].argmin(1)]).mean())
        scores["mean_distance_to_nearest_place"] = float(apart.mean())
    if driver is not None and exported_driver is not None:
        said = [np.array(list(_driven(one, images))) for one in (driver, exported_driver)]
        same = (said[0] == said[1]).mean((0, 2))
        scores |= {"same_linear": float(same[0]), "same_angular": float(same[1])}
    return Compared(embedding, apart, probability, scores)


def level_images(
    source: Path, networks: tuple[Trained, Trained], places: int, progress: Progress = lambda *_: None
) -> np.ndarray:
    """[P, K, H, W, 3] u8: level images around places of a dataset, or of a scene, which is drawn."""
    source = Path(source)
    if (source / "dataset.json").is_file():
        images = load_rooms(source).images[:, PITCHES.index("level")]
        return images[np.unique(np.linspace(0, len(images) - 1, places).round().astype(int))]
    if not (source / "scene.json").is_file():
        raise ConfigError(
            f"{source}: is neither a dataset nor a scene; name one whose images to compare by: --images PATH"
        )
    data, scene = camera_of(*networks), load_scene(source)
    robot = get_robot(data.robot)
    xy = free_space(scene, robot.height_m).sample(np.random.default_rng([0, 19]), places, data.clearance_m)
    return Pictures(scene, data, robot, progress).draw_around(xy, headings(data), scene.name)


def _driven(policy: TrainedPolicy, images: np.ndarray) -> Iterator[np.ndarray]:
    """[2, P] velocities at each of K steps."""
    state = policy.start(len(images))
    for step in range(images.shape[1]):
        state, linear, angular = policy.act(state, images[:, step])
        yield np.stack([linear, angular])


def _export_run(task: str, run: Path, out: Path, config: ExportConfig) -> dict[str, Any]:
    """Writes a run's folder and returns where it came from."""
    for name in (CONFIG, VERSIONS, RESULTS):
        if not (run / name).is_file():
            raise RunError(f"{run}: has no {name}; finish the run first")
    reader = Reader(RunError, "finish the run first", finite=False)
    made = reader.typed(reader.json(run / VERSIONS), dict[str, Any], f"{run / VERSIONS}")
    made["commit"] = made.get("commit") or config.commit
    made["argv"] = [_without_folder(word) for word in made.get("argv", [])]
    device = reader.typed(made.get("device", {}), dict[str, Any], f"{run / VERSIONS}: device").get("kind")
    if not made["commit"] or not device:
        raise RunError(f"{run}: {VERSIONS} names no {'device' if made['commit'] else 'commit'}; say commit=HASH")
    about = json.loads((run / DESCRIPTION).read_text())
    tensors, _ = weights.read_weights(weights_file(run), RunError, "train again")
    if task == "policy":
        for network, other in zip(about["networks"], ("rooms", "passages"), strict=True):
            network["run"] = f"../{other}"
    header = {**shown(about), "commit": made["commit"]}
    header = weights.write_weights(out / PACKED_WEIGHTS, weights.half(tensors), header)
    about["export"] = {"precision": PRECISION, "weights_digest": header["digest"]}
    write_text(out / DESCRIPTION, json.dumps(about, indent=1) + "\n")
    write_text(out / VERSIONS, json.dumps(made, indent=1) + "\n")
    for name in (CONFIG, RESULTS):
        shutil.copyfile(run / name, out / name)
    return {
        "digest": about["digest"],
        "parameters": about["parameters"],
        "commit": made["commit"],
        "device": device,
        "command": made["argv"],
    }


def _export_map(path: Path, out: Path, networks: tuple[Trained, Trained]) -> dict[str, Any]:
    made = load_map(path)
    for name, network in zip(("localiser", "detector"), networks, strict=True):
        if made.about.get(name) != network.about["digest"]:
            raise MapError(f"{path}: was made with another {name}; build the map again with the exported one")
    save_map(dataclasses.replace(made, embeddings=made.embeddings.astype(np.float16)), out)
    return {"scene_digest": made.digest, "nodes": len(made.xy_w), "edges": len(made.edges)}


def _without_folder(word: str) -> str:
    """A word of a command line; an absolute path without the folders that it has on one machine alone."""
    key, sign, value = word.rpartition("=")
    return f"{key}{sign}{PurePath(value).name}" if PurePath(value).is_absolute() else word
