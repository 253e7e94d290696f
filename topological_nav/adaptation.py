"""Adapt networks and maps to another domain.

Features: ADDA (Tzeng et al. 2017). A critic learns to separate embeddings of source images from those of target images
by a second extractor, which starts as the source's and learns to deceive the critic. The source's extractor is frozen;
labels and positions of target images are not used.

Passages: four configurations of a detector. Maps: built from images collected in the target domain.

| | not fine-tuned | fine-tuned on target images |
|---|---|---|
| fresh weights | A | B |
| trained on the source | C | D |
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from interactive_nav import get_robot, load_scene
from interactive_nav_common.config import to_dict
from interactive_nav_common.errors import FileError
from interactive_nav_common.files import write_json
from interactive_nav_common.rows import digest_of
from interactive_nav_common.runs.folder import claimed, run_epochs
from topological_nav.config import PITCHES
from topological_nav.data.dataset import PassageImages, RoomImages, balanced, load_passages, load_rooms, read_header
from topological_nav.data.domains import PRESETS, AdaptConfig, as_seen
from topological_nav.learn import learning
from topological_nav.learn.networks import Network, Places, in_words, joined, localisation_scores, normalised
from topological_nav.learn.training import (
    Trained,
    class_scores,
    length_scores,
    load_networks,
    load_trained,
    localisation,
    need_task,
    rows_by_scene,
    save_trained,
)
from topological_nav.maps.build import judged_map
from topological_nav.maps.graph import near_pairs
from topological_nav.scenes.space import FreeSpace, free_space

ROOMS_STREAM, PASSAGES_STREAM = 1, 2
"""Random streams of target images."""


@flax.struct.dataclass
class Adapting(learning.Learner):
    """Add a critic to the state of the target's network, whose heads remain the source's."""

    critic: Any
    critic_opt_state: Any


def embed_training(network: Network, variables: Any, images: jax.Array) -> tuple[jax.Array, Any]:
    """Return embeddings [N, D] by batch statistics, and updated running statistics."""
    embeddings, new = network.apply(
        variables, images, method=lambda module, x: joined(module.body(normalised(x), True)), mutable=["batch_stats"]
    )
    return embeddings, new.get("batch_stats", variables["batch_stats"])  # type: ignore[union-attr,return-value]


def make_adapting(variables: dict[str, Any], size: int, config: AdaptConfig) -> tuple[Adapting, nn.Sequential]:
    """Return a target extractor equal to the source's, and a fresh critic, positive [N, 1] for the source."""
    hidden, act = config.hidden, nn.leaky_relu
    critic = nn.Sequential([nn.Dense(hidden), act, nn.Dense(hidden), act, nn.Dense(1)])
    shapes = jax.eval_shape(critic.init, jax.random.PRNGKey(0), jax.ShapeDtypeStruct((1, size), jnp.float32))
    weights = learning.initial(shapes, config.seed)["params"]
    # Copies: an epoch gives its argument's memory away, and the source's network is still needed.
    params, stats = jax.tree.map(jnp.array, (variables["params"], variables["batch_stats"]))
    tx, critic_tx = _optimisers(config)
    return Adapting(params, stats, tx.init(params), weights, critic_tx.init(weights)), critic


def adversarial_epoch(network: Network, critic: nn.Sequential, config: AdaptConfig):
    """Build an epoch that updates the critic, then the extractor, for each batch of target images.

    The source's embeddings [S, D] replace labels. Means are the extractor's `loss`, `critic_loss` and `critic_accuracy`
    before the update (0.5: the domains look alike).
    """
    tx, critic_tx = _optimisers(config)

    def critic_loss(weights, source, target):
        logits: Any = [critic.apply({"params": weights}, x) for x in (source, target)]
        # log(1 + e^-x) for the source, log(1 + e^x) for the target.
        loss = (nn.softplus(-logits[0]).mean() + nn.softplus(logits[1]).mean()) / 2
        return loss, ((logits[0] > 0).mean() + (logits[1] <= 0).mean()) / 2

    def extractor_loss(params, stats, weights, x):
        target, new = embed_training(network, {"params": params, "batch_stats": stats}, x)
        logits: Any = critic.apply({"params": weights}, target)
        return nn.softplus(-logits).mean(), new

    def update(state: Adapting, images, source, step):
        rows, key = step
        x = images[rows]
        drawn = source[jax.random.randint(key, (len(rows),), 0, len(source))]
        target, _ = embed_training(network, state.variables, x)
        (critics, right), slope = jax.value_and_grad(critic_loss, has_aux=True)(state.critic, drawn, target)
        change, critic_opt = critic_tx.update(slope, state.critic_opt_state, state.critic)
        weights: Any = optax.apply_updates(state.critic, change)
        grad = jax.value_and_grad(extractor_loss, has_aux=True)
        (loss, stats), slope = grad(state.params, state.batch_stats, weights, x)
        change, opt = tx.update(slope, state.opt_state, state.params)
        new = Adapting(optax.apply_updates(state.params, change), stats, opt, weights, critic_opt)
        return new, {"loss": loss, "critic_loss": critics, "critic_accuracy": right}

    return learning.compiled_epoch(learning.keyed_batches(config.batch), update)


def target_statistics(trained: Trained, images: np.ndarray, batch: int, passes: int = 3) -> Trained:
    """Return the network with batch statistics of other images [N, H, W, 3] u8 (AdaBN, Li et al. 2016), a baseline."""
    step = jax.jit(lambda stats, x: embed_training(trained.network, {**trained.variables, "batch_stats": stats}, x)[1])
    stats, size = trained.variables["batch_stats"], min(batch, len(images))
    order = np.random.default_rng(0).permutation(len(images))
    for _ in range(passes):
        for first in range(0, len(images) - size + 1, size):
            stats = step(stats, jnp.asarray(images[order[first : first + size]]))
    return dataclasses.replace(trained, variables={**trained.variables, "batch_stats": stats})


def adapt_features(run: Path, source: Path, target: Path, out: Path, config: AdaptConfig) -> dict[str, Any]:
    """Adapt a run's embedding to another domain, or resume; return results: localisation before, with AdaBN, after."""
    trained = load_trained(run)
    near, far = load_rooms(source), target_rooms(target, config)
    headers = [read_header(folder)[0] for folder in (source, target)]
    data = {name: digest_of(header, 12) for name, header in zip(("source", "target"), headers, strict=True)}
    with claimed(out, {"task": "features", **to_dict(config), "run": trained.about["digest"][:12], **data}):
        learned, unlabelled = (x.images[~x.test].reshape(-1, *x.images.shape[3:]) for x in (near, far))
        embedded = trained.embed(learned)
        state, critic = make_adapting(trained.variables, embedded.shape[1], config)
        epoch: Any = learning.over(adversarial_epoch(trained.network, critic, config), unlabelled, embedded)
        keys, kept = learning.phase_key(config.seed, 3), "checkpoint-features.msgpack"
        state = run_epochs(out, "features", state, epoch, config.epochs, keys, kept)
        adapted = save_trained(out, Trained(trained.network, state.variables, adapted_about(trained, config)))
        fitted = target_statistics(trained, unlabelled, config.batch)
        same = headers[0]["scenes"] == headers[1]["scenes"]
        results = {
            "target_images": len(unlabelled),
            "nodes": "of the source" if same else "of the target",
            "source": localisation_between(trained, near, trained, near),
        }
        for name, network in (("before", trained), ("statistics", fitted), ("after", adapted)):
            nodes = (trained, near) if same else (network, far)
            results[name] = localisation_between(*nodes, network, far)
        return write_json(out / learning.RESULTS, results)


def adapted_about(trained: Trained, config: AdaptConfig) -> dict[str, Any]:
    """Return the network.json of a network adapted from a trained one."""
    return {**trained.about, "adapted_from": trained.about["digest"], "domain": to_dict(PRESETS[config.domain])}


def target_rooms(folder: Path, config: AdaptConfig) -> RoomImages:
    """Return the room images of a dataset as the target's camera sees them."""
    rooms = load_rooms(folder)
    return dataclasses.replace(rooms, images=as_seen(rooms.images, PRESETS[config.domain], ROOMS_STREAM))


def localisation_between(
    node_network: Trained, node_rooms: RoomImages, query_network: Trained, query_rooms: RoomImages
) -> dict[str, Any]:
    """Score queries of one domain on nodes of another, and count them; see `training.localisation`."""
    rows = localisation(node_network, node_rooms, query_network, query_rooms)
    if not rows:
        raise FileError("source and target have no scene in common with positions for training and for testing")
    scored = (mine for name, mine in rows_by_scene(query_rooms).items() if name in rows)
    places = sum(int((mine & query_rooms.test).sum()) for mine in scored)
    return {**rows, "queries": places * len(range(0, query_rooms.images.shape[2], 3))}


def _optimisers(config: AdaptConfig):
    # Less momentum than usual: both sides of the game change.
    return optax.adam(config.learning_rate, b1=0.5), optax.adam(config.critic_learning_rate, b1=0.5)


CONFIGURATIONS = {"A": (False, False), "B": (False, True), "C": (True, False), "D": (True, True)}
"""Name -> whether weights are the source's, and whether they are fine-tuned."""


def passage_configurations(run: Path, target: Path, out: Path, config: AdaptConfig) -> dict[str, Any]:
    """Score a passage detector in another domain, with each of `CONFIGURATIONS`; return results.json."""
    trained = load_trained(run)
    need_task(trained.about, "passages", f"{run}:")
    learned, tested = labelled(target, trained.about["lengths_m"], config)
    header, _ = read_header(target)
    about = {"run": trained.about["digest"][:12], "target": digest_of(header, 12)}
    with claimed(out, {"task": "transfer", **to_dict(config), **about}):
        network, tx = trained.network, optax.adam(config.fine_tune_learning_rate)
        shape = (trained.about["data"]["height"], trained.about["data"]["width"])
        fresh = learning.Learner.start(learning.initial(learning.variable_shapes(network, shape), config.seed), tx)
        how = config.fine_tune_batch, 0.0, config.fine_tune_augment
        epoch = learning.labelled_epoch(network, tx, *how, learned.scored)
        one = learning.over(epoch, learned.images, learned.free.astype(np.int32))
        keys = learning.phase_key(config.seed, 3)
        results: dict[str, Any] = {"fine_tuned_on": len(learned.images), "tested_on": len(tested.images)}
        for name, (from_source, tunes) in CONFIGURATIONS.items():
            # A copy: an epoch gives its argument's memory away.
            learner = jax.tree.map(jnp.array, learning.Learner.start(trained.variables, tx) if from_source else fresh)
            if tunes:
                kept = f"checkpoint-{name}.msgpack"
                learner = run_epochs(out, name, learner, one, config.fine_tune_epochs, keys, kept)
            tuned = Trained(network, learner.variables, trained.about)
            logits, scored = tuned.logits(tested.images), tested.scored
            results[name] = class_scores(tested.free[:, scored], logits[:, scored] > 0, 2)
            results[name]["lengths"] = length_scores(logits, tested.free, trained.about["lengths_m"])
            if name == "D":
                save_trained(out, dataclasses.replace(tuned, about=adapted_about(trained, config)))
        return write_json(out / learning.RESULTS, results)


def collected_map(scene_folder: Path | None, target: Path, localiser: Path, detector: Path, config: AdaptConfig):
    """Build a map of images at a target dataset's training positions, without rendering any for the map.

    Photographs need no scene; all their places are nodes, and paths judged by hand keep that judgement. An edge is
    judged by its node's image nearest in angle, at most 10 degrees off for 18 headings. Scores of the `build.Built`
    include localisation of held-out target images.
    """
    networks = load_networks(localiser, detector, same=())
    header, data = read_header(target)
    rooms, first = target_rooms(target, config), header["scenes"][0]
    scene: Any = load_scene(scene_folder) if scene_folder else SimpleNamespace(**first)
    digests = [there["digest"] for there in header["scenes"]]
    if scene.digest not in digests:
        names = ", ".join(there["name"] for there in header["scenes"])
        raise FileError(f"{target}: holds images of {names} as they were, not of '{scene.name}' as it is")
    if not scene_folder and "by_hand" not in first:
        raise FileError(f"{target}: is no dataset of photographs; name the scene folder: adapt map SCENE")
    if "by_hand" in first and header["fov_deg"] != networks.camera.fov_deg:
        remedy = f"import them with fov_deg={networks.camera.fov_deg:g}, or train networks on this dataset"
        raise FileError(f"{target}: photographs are stored with fov_deg={header['fov_deg']:g}; {remedy}")
    here = rooms.scene == digests.index(scene.digest)
    nodes, held = here & ("by_hand" in first or ~rooms.test), here & rooms.test
    level = rooms.images[:, PITCHES.index("level")]
    shown, xy, label = level[nodes], rooms.xy_w[nodes], rooms.label[nodes]
    room = label - rooms.label[here].min()
    if not len(pairs := near_pairs(xy, config.edge_m)):
        raise FileError(f"no two positions of '{scene.name}' in {target} are within {config.edge_m} m; collect more")
    about = {"settings": to_dict(config), "data": header["settings"], "domain": to_dict(PRESETS[config.domain])}
    if scene_folder:
        space = free_space(scene, get_robot(data.robot).height_m)
    else:  # nothing but floor, a metre about the places
        (x, y), cells = xy.min(0).tolist(), np.ceil(np.ptp(xy, axis=0) / 0.1).astype(int) + 20
        space = FreeSpace(np.pad(np.ones(cells[::-1]), 1), 0.1, (x - 1.0, y - 1.0))
    built = judged_map(scene, space, xy, room, shown, networks, config.edge_m, config.passable, about)
    for start, end, opened in first.get("by_hand", ()):
        ends = [first["places"].index(place) if place in first["places"] else -1 for place in (start, end)]
        ways = (pairs == ends).all(1) | (pairs == ends[::-1]).all(1)
        if not ways.any() or opened not in ("yes", "no"):
            expected = f"two places with all headings, at most {config.edge_m} m apart, and yes or no"
            raise FileError(f"{target}: connectivity.csv has {start},{end},{opened}, expected {expected}")
        built.map.p[ways] = opened == "yes"
    if not scene_folder:  # there is no plan to compare with
        open_ = built.map.p >= config.passable
        built = dataclasses.replace(built, free=open_, scores={"edges": f"{int(open_.sum())} of {len(open_)} open"})
    if held.any() and "by_hand" not in first:
        queries = Places(networks.localiser.embed(level[held][:, ::3]), rooms.xy_w[held], rooms.label[held])
        nodes = Places(built.map.embeddings, built.map.xy_w, label)
        built.scores["held-out images localised"] = in_words(localisation_scores(queries, nodes))
    return built


def labelled(target: Path, lengths_m: Sequence[float], config: AdaptConfig) -> tuple[PassageImages, PassageImages]:
    """Return target images for training and testing, with disjoint sources and as many free as set, or half."""
    passages = load_passages(target)
    if list(passages.lengths_m) != list(lengths_m):
        lengths = ",".join(f"{length:g}" for length in lengths_m)
        raise FileError(
            f"{target}: passages are labelled for {list(passages.lengths_m)} m, the detector judges {list(lengths_m)}; "
            f"make it again with passage_lengths_m=[{lengths}]"
        )
    scored = passages.free[:, passages.scored]
    images = as_seen(passages.images, PRESETS[config.domain], PASSAGES_STREAM)
    rng, parts = np.random.default_rng([config.seed, 4]), []
    for held, most, free in ((False, config.fine_tune, config.fine_tune_free), (True, config.test, config.test_free)):
        rows = np.flatnonzero(passages.test == held)
        rows = rows if free else balanced(rows, scored, rng)
        free = free or most // 2
        yes, no = rng.permutation(rows[scored[rows]])[:free], rng.permutation(rows[~scored[rows]])[: most - free]
        rows = np.sort(np.concatenate([yes, no]))
        if not len(rows):
            what = "for testing" if held else "to learn from"
            raise FileError(f"{target}: has no passages {what}; make it with more passage_sources or test_share")
        chosen = {name: getattr(passages, name)[rows] for name in ("free", "scene", "test")}
        parts.append(dataclasses.replace(passages, images=images[rows], **chosen))
    return parts[0], parts[1]
