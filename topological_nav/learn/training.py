"""Train a network for rooms or passages on a dataset, from scratch or from a run's backbone; load networks.

RUN/config.yaml      settings; the same settings resume the run
    versions.json    packages, device, commit
    metrics.jsonl    one line per epoch
    checkpoint.msgpack  learner after the last epoch
    weights.safetensors, network.json   the trained network and how to build it
    results.json     scores on held-out data
    curves.png
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from sklearn.metrics import confusion_matrix, f1_score

from interactive_nav_common.config import overlay, to_dict
from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import write_json
from interactive_nav_common.runs.folder import claimed, run_epochs
from topological_nav.config import PITCHES, DataConfig, NetworkTrainConfig
from topological_nav.data.dataset import RoomImages, load_passages, load_rooms, logits_at, read_header
from topological_nav.learn import learning
from topological_nav.learn.networks import Network, Places, localisation_scores

SAME = ("robot", "engine", "width", "height", "fov_deg")
"""Image settings that two networks must share to use one camera."""


@dataclasses.dataclass(frozen=True)
class Trained:
    """Hold a network and its weights."""

    network: Network
    variables: dict[str, Any]
    about: dict[str, Any]
    """Content of network.json."""
    run: Path = Path()
    """Folder that it was read from."""
    asked_m: float | None = None
    """Length for which `passage` always answers; None: the requested one."""

    @property
    def stored(self) -> str:
        """Return an identifier of its values: the run's digest, and an export's precision."""
        return self.about["digest"] + (f"-{self.about['export']['precision']}" if "export" in self.about else "")

    def logits(self, images: np.ndarray) -> np.ndarray:
        """Return logits [..., outputs] of images [..., H, W, 3] u8, of the size that it was trained on."""
        return self._rows(images, "__call__")

    def passage(self, images: np.ndarray, ahead_m: np.ndarray | float) -> np.ndarray:
        """Return the probability that the path is free for `ahead_m`, of images [N, H, W, 3]; see `logits_at`."""
        logits = self.logits(images).astype(float)
        ahead_m = ahead_m if self.asked_m is None else np.full(np.shape(ahead_m), self.asked_m)
        return 1.0 / (1.0 + np.exp(-logits_at(logits, self.about["lengths_m"], ahead_m)))

    def embed(self, images: np.ndarray) -> np.ndarray:
        """Return localisation embeddings [..., D] of images [..., H, W, 3] u8; see `Network.embed`."""
        return self._rows(images, "embed")

    def _rows(self, images: np.ndarray, method: str) -> np.ndarray:
        expected = (self.about["data"]["height"], self.about["data"]["width"], 3)
        if images.shape[-3:] != expected:
            raise FileError(f"images are {images.shape[-3:]}, expected {expected}, which the network learned from")
        method_of = functools.partial(_applied, self.network, method, self.variables)
        rows = learning.in_batches(method_of, images.reshape(-1, *expected))
        return rows.reshape(*images.shape[:-3], *rows.shape[1:])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _applied(network: Network, method: str, variables: Any, images: jax.Array) -> Any:
    return network.apply(variables, images, method=method)


@dataclasses.dataclass(frozen=True)
class _Work:
    """Hold the images that a run is trained on and scored by."""

    rooms: RoomImages
    images: np.ndarray
    """[N, H, W, 3] u8 for learning."""
    labels: np.ndarray
    """[N] i32; of passages [N, L]."""
    held_out: np.ndarray
    """[M, H, W, 3] u8."""
    truth: np.ndarray
    """[M] i32; of passages [M, L]."""
    groups: dict[str, np.ndarray]
    """Name -> rows of `held_out` that are scored together."""
    lengths_m: tuple[float, ...] = ()
    """[L] of passages; empty for rooms."""
    scored: int = 0
    """Index of the length that passages are scored by."""


def train(task: str, dataset: Path, out: Path, config: NetworkTrainConfig) -> dict[str, Any]:
    """Train a network for rooms or passages, or continue the run at `out`; return the content of results.json."""
    header, data = read_header(dataset)
    work = _work(task, dataset, config)
    with claimed(out, {"task": task, "dataset": header, **to_dict(config)}):
        outputs, tx = len(work.lengths_m or work.rooms.names), optax.adam(config.learning_rate)
        network = Network(task, config.network, config.width, config.hidden, outputs, config.first_stage)
        shapes = learning.variable_shapes(network, (data.height, data.width))
        learner = learning.Learner.start(learning.initial(shapes, config.seed), tx)
        if config.init != "scratch":
            donor = load_trained(Path(config.init))
            about = f"it is {donor.about['backbone']} of width {donor.about['width']}"
            learner = learning.with_backbone(learner, donor.variables, f"init: {config.init} does not fit", about)
        epoch = learning.labelled_epoch(network, tx, config.batch, config.label_smoothing, config.augment, work.scored)
        one = learning.over(epoch, work.images, work.labels)
        learner = run_epochs(out, "labels", learner, one, config.epochs, learning.phase_key(config.seed, 2))
        about = {
            "task": task,
            "backbone": config.network,
            "width": config.width,
            "hidden": config.hidden,
            "first_stage": config.first_stage,
            "outputs": outputs,
            "names": list(work.rooms.names) if task == "rooms" else ["blocked", "free"],
            **({"lengths_m": list(work.lengths_m)} if task == "passages" else {}),
            "data": header["settings"],
            "fov_deg": header["fov_deg"],
            "parameters": int(sum(np.size(x) for x in jax.tree.leaves(learner.params))),
        }
        trained = save_trained(out, Trained(network, learner.variables, about))
        return write_json(out / learning.RESULTS, _scores(trained, work))


def save_trained(out: Path, trained: Trained) -> Trained:
    """Write a network for `load_trained`; return it with the digest of its weights in `about`."""
    about = {name: value for name, value in trained.about.items() if name != "export"}
    learning.write_network(out, trained.variables, about)
    return dataclasses.replace(trained, about=about)


def load_trained(run: Path) -> Trained:
    """Load the network of a finished run or of an export, with f32 weights."""
    run = Path(run)
    about = learning.read_description(run, "network", "TASK")
    with readable(run / learning.DESCRIPTION, FileError, "train again"):
        if about["task"] == "passages" and not about.get("lengths_m"):
            raise ValueError("it names no lengths_m for which it judges passages")
        shape = (about["width"], about["hidden"], about["outputs"], about.get("first_stage", 2))
        network = Network(about["task"], about["backbone"], *shape)
        template = learning.variable_shapes(network, (about["data"]["height"], about["data"]["width"]))
    return Trained(network, learning.read_weights(run, template, about), about, run)


def _work(task: str, dataset: Path, config: NetworkTrainConfig) -> _Work:
    names = PITCHES if config.pitch == "all" else (config.pitch,)
    rooms = load_rooms(dataset, list({"level": 0} if task == "passages" else dict.fromkeys((*names, "level"))))
    size = rooms.images.shape[3:]
    if task == "passages":
        passages = load_passages(dataset)
        test, free = passages.test, passages.free.astype(np.int32)
        if config.test_scenes:
            scenes = [scene["name"] for scene in read_header(dataset)[0]["scenes"]]
            if missing := set(config.test_scenes) - set(scenes):
                raise FileError(
                    f"{dataset}: has no scene {', '.join(sorted(missing))}, expected among {', '.join(scenes)}"
                )
            test = np.isin(passages.scene, [scenes.index(name) for name in config.test_scenes])
        groups = {"all": np.arange(int(test.sum()))}
        if test.all():
            remedy = "name fewer test_scenes" if config.test_scenes else "label free_m, or make it with passage_sources"
            raise FileError(f"{dataset}: has no passages to learn from; {remedy}")
        sides = passages.images[~test], free[~test], passages.images[test], free[test]
        return _Work(rooms, *sides, groups, passages.lengths_m, passages.scored)
    if len(rooms.names) < 2:
        raise FileError(f"{dataset}: has one room, expected two to tell apart; label more, or take other networks")
    learned, held_out = rooms.of(names, ~rooms.test), rooms.of(names, rooms.test)
    count, around = len(held_out), held_out.shape[2]
    turns = np.broadcast_to(np.arange(0, around, 3), (count, around // 3))
    if config.test_headings == "random":
        rng = np.random.default_rng([config.seed, 8])
        turns = np.sort(rng.permuted(np.tile(np.arange(around), (count, 1)), axis=1)[:, : around // 3], 1)
    held_out = np.take_along_axis(held_out, turns[:, None, :, None, None, None], 2)
    label, truth = (
        np.broadcast_to(rooms.label[test][:, None, None], images.shape[:3]).ravel().astype(np.int32)
        for test, images in ((~rooms.test, learned), (rooms.test, held_out))
    )
    pitch = np.broadcast_to(np.arange(len(names))[None, :, None], held_out.shape[:3]).ravel()
    groups = {name: np.flatnonzero(pitch == index) for index, name in enumerate(names)}
    groups |= {"all": np.arange(len(pitch))} if config.pitch == "all" else {}
    return _Work(rooms, learned.reshape(-1, *size), label, held_out.reshape(-1, *size), truth, groups)


def _scores(trained: Trained, work: _Work) -> dict[str, Any]:
    """Return accuracy and macro F1 on held-out images, and localisation scores of the embedding."""
    results = {name: trained.about[name] for name in ("task", "parameters")} | {"trained_on": len(work.images)}
    if len(work.held_out):
        logits, truth, is_passages = trained.logits(work.held_out), work.truth, bool(work.lengths_m)
        if is_passages:
            results["lengths"] = length_scores(logits, truth, work.lengths_m)
            chosen, truth = (logits[:, work.scored] > 0).astype(np.int32), truth[:, work.scored]
        else:
            chosen = logits.argmax(1)
        results["groups"] = {
            name: {"images": len(rows), **class_scores(truth[rows], chosen[rows])} for name, rows in work.groups.items()
        }
        if is_passages:
            results["confusion"] = confusion_matrix(truth, chosen, labels=[0, 1]).tolist()
    results["localisation"] = localisation(trained, work.rooms)
    return results


def class_scores(truth: np.ndarray, chosen: np.ndarray, classes: int = 0) -> dict[str, Any]:
    """Return accuracy and macro F1 of classes [N]; given their number, also the confusion, a row per true class."""
    out = {"accuracy": float((chosen == truth).mean()), "macro_f1": float(f1_score(truth, chosen, average="macro"))}
    return out | ({"confusion": confusion_matrix(truth, chosen, labels=range(classes)).tolist()} if classes else {})


def length_scores(logits: np.ndarray, free: np.ndarray, lengths_m: Sequence[float]) -> list[dict[str, float]]:
    """Return each length's share of free images, and accuracy; logits and `free` are [N, L]."""
    return [
        {"ahead_m": length, "free": float(truth.mean()), "accuracy": float(((logit > 0) == truth).mean())}
        for length, logit, truth in zip(lengths_m, logits.T, free.T, strict=True)
    ]


def localisation(
    trained: Trained, rooms: RoomImages, other: Trained | None = None, other_rooms: RoomImages | None = None
) -> dict[str, Any]:
    """Score an embedding by scene: training positions are nodes, every third level image of test positions a query.

    `mean` weighs scenes by queries; see `networks.localisation_scores`. Queries are images of `other_rooms` embedded by
    `other` (defaults: the same), in the scenes that both have.
    """
    other, other_rooms = other or trained, other_rooms or rooms
    rows, weights, there = {}, [], rows_by_scene(other_rooms)
    for name, mine in rows_by_scene(rooms).items():
        nodes, queries = mine & ~rooms.test, there.get(name, np.zeros_like(other_rooms.test)) & other_rooms.test
        if nodes.any() and queries.any():
            looked = other.embed(other_rooms.of(["level"], queries)[:, 0, ::3])
            shown = trained.embed(rooms.of(["level"], nodes)[:, 0])
            rows[name] = localisation_scores(
                Places(looked, other_rooms.xy_w[queries], other_rooms.label[queries]),
                Places(shown, rooms.xy_w[nodes], rooms.label[nodes]),
            )
            weights.append(int(queries.sum()))
    if rows:
        keys = next(iter(rows.values()))
        rows["mean"] = {k: float(np.average([r[k] for r in rows.values()], weights=weights)) for k in keys}
    return rows


def rows_by_scene(rooms: RoomImages) -> dict[str, np.ndarray]:
    """Return scene name -> [P] bool."""
    names = np.array([rooms.names[label].rpartition("/")[0] for label in rooms.label])
    return {str(name): names == name for name in dict.fromkeys(names.tolist())}


def camera_settings(network: Trained) -> dict[str, Any]:
    """Return the settings of the images that a network was trained on, with the lens as it was."""
    return {**network.about["data"], "fov_deg": network.about["fov_deg"]}


def need_task(about: dict[str, Any], task: str, who: str) -> None:
    """Refuse a run of another task."""
    if about["task"] != task:
        raise FileError(f"{who} was trained for '{about['task']}', expected a run of 'train {task}'")


class Networks(NamedTuple):
    """Group a navigator's networks."""

    localiser: Trained
    detector: Trained

    @property
    def camera(self) -> DataConfig:
        """Return the camera settings that both networks were trained with."""
        return overlay(DataConfig(), camera_settings(self.localiser), "network.json")

    def asking(self, asked_m: float | None) -> "Networks":
        """Return the networks with a detector that always answers for this length; None: for the requested one."""
        return self._replace(detector=dataclasses.replace(self.detector, asked_m=asked_m))

    @property
    def digests(self) -> dict[str, str]:
        """Return the digests of the weights under the names that maps use."""
        return {name: network.about["digest"] for name, network in zip(self._fields, self, strict=True)}


def load_networks(
    localiser: Path, detector: Path, classifies: bool = False, same: Sequence[str] = (*SAME, "headings")
) -> Networks:
    """Load two runs' networks that share the settings `same`; if `classifies`, the localiser must classify rooms."""
    networks = Networks(load_trained(localiser), load_trained(detector))
    if classifies:
        need_task(networks.localiser.about, "rooms", f"{localiser}:")
    need_task(networks.detector.about, "passages", f"{detector}:" if classifies else "the detector")
    first, second = map(camera_settings, networks)
    for name in same:
        if first[name] != second[name]:
            raise FileError(
                f"the localiser learned from images with {name} = {first[name]!r}, the detector {second[name]!r}; "
                "train both on one dataset"
            )
    return networks
