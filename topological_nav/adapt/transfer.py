"""A passage detector's four configurations in another domain, and a map of images collected there.

| | not fine-tuned | fine-tuned on target images |
|---|---|---|
| fresh weights | A | B |
| learned from the source | C | D |
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.config import to_dict
from interactive_nav_common.rows import digest_of
from topological_nav.adapt.adaptation import PASSAGES_STREAM, adapted_about, epoch_keys, target_rooms
from topological_nav.adapt.config import AdaptConfig
from topological_nav.config import PITCHES
from topological_nav.data.dataset import PassageImages, load_passages, read_header
from topological_nav.data.domains import as_seen, preset
from topological_nav.data.passages import balanced
from topological_nav.errors import ALONE, DatasetError, Host, MapError
from topological_nav.learn.learning import Learner, labelled_epoch, make_learner, over
from topological_nav.learn.networks import Places, in_words, localisation_scores
from topological_nav.learn.runs import claimed, run_epochs, write_results
from topological_nav.learn.training import (
    Networks,
    Trained,
    class_scores,
    length_scores,
    load_trained,
    need_task,
    save_trained,
)
from topological_nav.maps.build import judged_map
from topological_nav.maps.graph import near_pairs
from topological_nav.scenes.space import free_space

CONFIGURATIONS = {"A": (False, False), "B": (False, True), "C": (True, False), "D": (True, True)}
"""Name -> whether the weights are the source's, and whether they are fine-tuned."""


def passage_configurations(
    run: Path, target: Path, out: Path, config: AdaptConfig, host: Host = ALONE
) -> dict[str, Any]:
    """Score a passage detector in another domain, learned from the source or not, fine-tuned or not.

    Return the content of results.json.
    """
    trained = load_trained(run)
    need_task(trained.about, "passages", f"{run}:")
    learned, tested = _labelled(target, trained.about["lengths_m"], config)
    header, _ = read_header(target)
    about = {"run": trained.about["digest"][:12], "target": digest_of(header, 12)}
    with claimed(out, {"task": "transfer", **to_dict(config), **about}):
        network, tx = trained.network, optax.adam(config.fine_tune_learning_rate)
        shape = (trained.about["data"]["height"], trained.about["data"]["width"])
        fresh = make_learner(network, shape, tx, config.seed)
        epoch = labelled_epoch(network, tx, config.fine_tune_batch, 0.0, True, learned.scored)
        one, keys = over(epoch, learned.images, learned.free.astype(np.int32)), epoch_keys(config)
        results: dict[str, Any] = {"fine_tuned_on": len(learned.images), "tested_on": len(tested.images)}
        for name, (from_source, tunes) in CONFIGURATIONS.items():
            # A copy: an epoch gives its argument's memory away.
            learner = jax.tree.map(jnp.array, Learner.start(trained.variables, tx) if from_source else fresh)
            if tunes:
                kept = f"checkpoint-{name}.msgpack"
                learner = run_epochs(out, name, learner, one, config.fine_tune_epochs, keys, host, kept)
            tuned = Trained(network, learner.variables, trained.about)
            results[name] = _scores(tuned, tested)
            if name == "D":
                save_trained(out, dataclasses.replace(tuned, about=adapted_about(trained, config)))
        return write_results(out, results)


def collected_map(scene_folder: Path, target: Path, localiser_run: Path, detector_run: Path, config: AdaptConfig):
    """Build a map of images collected in the target domain: its training positions, no image drawn for the map.

    An edge is judged by the image of its node nearest to it in angle, 10 degrees off at most for 18 headings. Scores of
    the `build.Built` say how held-out images of the target are localised on it.
    """
    localiser, detector = load_trained(localiser_run), load_trained(detector_run)
    need_task(detector.about, "passages", "the detector")
    scene = load_scene(scene_folder)
    header, data = read_header(target)
    rooms = target_rooms(target, config)
    here = rooms.scene == _index_of(scene, header, target)
    nodes, held = here & ~rooms.test, here & rooms.test
    level = rooms.images[:, PITCHES.index("level")]
    shown, xy, label = level[nodes], rooms.xy_w[nodes], rooms.label[nodes]
    room = label - rooms.label[here].min()
    if not len(near_pairs(xy, config.edge_m)):
        raise MapError(f"no two positions of '{scene.name}' in {target} are within {config.edge_m} m; collect more")
    about = {"settings": to_dict(config), "data": header["settings"], "domain": to_dict(preset(config.domain))}
    space, networks = free_space(scene, get_robot(data.robot).height_m), Networks(localiser, detector, data)
    built = judged_map(scene, space, xy, room, shown, networks, config.edge_m, config.passable, about)
    if held.any():
        queries = Places(localiser.embed(level[held][:, ::3]), rooms.xy_w[held], rooms.label[held])
        nodes = Places(built.map.embeddings, built.map.xy_w, label)
        built.scores["held-out images localised"] = in_words(localisation_scores(queries, nodes))
    return built


def _index_of(scene: Scene, header: dict[str, Any], target: Path) -> int:
    """Return which scene of a dataset it is."""
    digests = [there["digest"] for there in header["scenes"]]
    if scene.digest not in digests:
        names = ", ".join(there["name"] for there in header["scenes"])
        raise DatasetError(f"{target}: holds images of {names} as they were, not of '{scene.name}' as it is")
    return digests.index(scene.digest)


def _labelled(target: Path, lengths_m: Sequence[float], config: AdaptConfig) -> tuple[PassageImages, PassageImages]:
    """Return target images to learn from and to test, as many free as blocked, no source in both."""
    passages = load_passages(target)
    if list(passages.lengths_m) != list(lengths_m):
        lengths = ",".join(f"{length:g}" for length in lengths_m)
        raise DatasetError(
            f"{target}: passages are labelled for {list(passages.lengths_m)} m, the detector judges {list(lengths_m)}; "
            f"make it again with passage_lengths_m=[{lengths}]"
        )
    scored = passages.free[:, passages.scored]
    images = as_seen(passages.images, preset(config.domain), PASSAGES_STREAM)
    rng, parts = np.random.default_rng([config.seed, 4]), []
    for held, most in ((False, config.fine_tune), (True, config.test)):
        rows = balanced(np.flatnonzero(passages.test == held), scored, rng)
        yes, no = (rng.permutation(rows[scored[rows] == label])[: most // 2] for label in (True, False))
        rows = np.sort(np.concatenate([yes, no]))
        if not len(rows):
            what = "for testing" if held else "to learn from"
            raise DatasetError(f"{target}: has no passages {what}; make it with more passage_sources or test_share")
        chosen = {name: getattr(passages, name)[rows] for name in ("free", "scene", "test")}
        parts.append(dataclasses.replace(passages, images=images[rows], **chosen))
    return parts[0], parts[1]


def _scores(trained: Trained, tested: PassageImages) -> dict[str, Any]:
    logits = trained.logits(tested.images)
    predicted, truth = logits[:, tested.scored] > 0, tested.free[:, tested.scored]
    return {
        **class_scores(truth, predicted, 2),
        "lengths": length_scores(logits, tested.free, trained.about["lengths_m"]),
    }
