"""What drives along an edge of the map: images in, velocities out, ten times a second."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from topological_nav.config import PASSAGE_POLICY, DriveConfig, NavigatorConfig
from topological_nav.drives.dataset import Drives, drive_images, load_drives, read_drives_header
from topological_nav.drives.policy import Forward, Policy, fresh_params, standardised
from topological_nav.errors import ALONE, Host, RunError, Stopped
from topological_nav.learn.learning import in_batches
from topological_nav.learn.runs import read_description, read_weights
from topological_nav.learn.training import SAME, Trained, load_pair, need_task, seen_by
from topological_nav.maps.sight import PassagePolicy, Sight

_TOLD_EVERY = 10
"""Files of images between two lines about embedding."""


@dataclasses.dataclass(frozen=True)
class Frames:
    """Drives of a folder and the embeddings of their images."""

    drives: Drives
    config: DriveConfig
    header: dict[str, Any]
    features: np.ndarray
    """[F or 2 F, D] f16 of all control steps, 0 where nothing was drawn; then the same of mirrored images."""
    networks: tuple[Trained, Trained]
    """Of rooms and of passages."""
    runs: tuple[Path, Path]

    @property
    def mirrored(self) -> bool:
        """Whether there are mirrored ones."""
        return len(self.features) > len(self.drives.command)


def embed_drives(folder: Path, localiser_run: Path, detector_run: Path, mirror: bool, host: Host = ALONE) -> Frames:
    """Embed the images of all kept drives."""
    header, config = read_drives_header(folder)
    drives, networks = load_drives(folder), load_pair(localiser_run, detector_run)
    mine, theirs = {**header["settings"], "fov_deg": header["fov_deg"]}, seen_by(networks[0])
    for name in SAME:
        if mine[name] != theirs[name]:
            raise RunError(
                f"{folder}: images have {name} = {mine[name]!r}, the networks learned from {theirs[name]!r}; drive "
                f"again with {name}={theirs[name]}"
            )
    count, total, done = len(drives.command), int(drives.steps[drives.kept].sum()), 0
    features: np.ndarray | None = None
    embed = _embedder(networks, mirror)
    for i, (rows, images) in enumerate(drive_images(folder)):
        at, part = drives.rows(rows), in_batches(embed, images)
        if features is None:
            features = np.zeros((part.shape[1] * count, part.shape[2]), np.float16)
        for side in range(part.shape[1]):
            features[at + side * count] = part[:, side]
        done += len(images)
        if i % _TOLD_EVERY == 0 or done == total:
            host.tell(f"embedded {done:,} of {total:,} images")
        if stop := host.signal():
            raise Stopped(stop)
    if features is None:
        raise RunError(f"{folder}: none of {len(drives)} drives was kept; drive more, or in other scenes")
    return Frames(drives, config, header, features, networks, (Path(localiser_run), Path(detector_run)))


def embedded(networks: Sequence[Trained], weights: Any, images: jax.Array) -> jax.Array:
    """[N, D] embeddings of images [N, H, W, 3] by all networks, one network after the other."""
    pairs = zip(networks, weights, strict=True)
    return jnp.concatenate([network.network.apply(w, images, method="embed") for network, w in pairs], -1)  # type: ignore[arg-type]


def _embedder(networks: Sequence[Trained], mirror: bool) -> Callable[[jax.Array], jax.Array]:
    """Compiled: images [N, H, W, 3] to [N, 1 or 2, D] f16, all networks' embeddings, then those of the mirrored."""

    @jax.jit
    def sides(weights: Any, images: jax.Array) -> jax.Array:
        shown = (images, images[:, :, ::-1]) if mirror else (images,)
        return jnp.stack([embedded(networks, weights, side) for side in shown], 1).astype(jnp.float16)

    return functools.partial(sides, [network.variables for network in networks])


class LocalPolicy(Protocol):
    """Drives by images alone; what it remembers travels in a state that belongs to the caller."""

    def start(self, batch: int) -> Any:
        """Hidden state of `batch` fresh runs."""
        ...

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """images (B, H, W, 3) uint8 level, straight ahead -> new state, linear (B,) m/s, angular (B,) rad/s."""
        ...


class TrainedPolicy:
    """A `LocalPolicy` that was learned: at each step the likeliest class of either velocity."""

    def __init__(self, policy: Policy, variables: dict[str, Any], about: dict[str, Any], networks: Any):
        """Takes what `load_policy` read; compiles at the first step of each batch size."""
        self.about: dict[str, Any] = about
        """Content of network.json."""
        self._networks: tuple[Trained, Trained] = networks
        self._policy = policy
        data = self._networks[0].about["data"]
        self._shape = (data["height"], data["width"], 3)
        weights = {"policy": variables, "embedders": [n.variables for n in self._networks]}
        self._weights = jax.tree.map(jnp.asarray, weights)
        self._step = jax.jit(self._stepped)

    def start(self, batch: int) -> Any:
        """See `LocalPolicy`."""
        fresh = np.zeros((batch, self._policy.hidden), np.float32)
        return fresh, fresh.copy()

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """See `LocalPolicy`."""
        if images.shape[1:] != self._shape:
            raise RunError(f"images are {images.shape[1:]}, expected {self._shape}, the size that it learned from")
        state, (linear, angular) = jax.device_get(self._step(self._weights, state, jnp.asarray(images)))
        return state, np.asarray(self.about["linear_m_s"])[linear], np.asarray(self.about["angular_rad_s"])[angular]

    def _stepped(self, weights, state, images):
        x = standardised(embedded(self._networks, weights["embedders"], images), weights["policy"]["scale"])
        state, logits = self._policy.apply({"params": weights["policy"]["params"]}, state, x)  # type: ignore[misc]
        return state, tuple(one.argmax(-1) for one in logits)


def load_policy(
    run_folder: Path | str, localiser: Path | str | None = None, detector: Path | str | None = None
) -> TrainedPolicy:
    """Return the policy of a finished run.

    `localiser` and `detector` are run folders of the networks that embed its images; None: where they were when it
    learned, relative to the run folder.
    """
    run = Path(run_folder)
    about = read_description(run, "policy", "policy")
    need_task(about, "policy", f"{run}:")
    recorded = [run / network["run"] for network in about["networks"]]
    paths = [Path(given or there) for given, there in zip((localiser, detector), recorded, strict=True)]
    networks = load_pair(paths[0], paths[1])
    for path, network, learned in zip(paths, networks, about["networks"], strict=True):
        if learned["digest"] not in (network.about["digest"], network.about.get("adapted_from")):
            raise RunError(f"{path}: is not the network that {run} learned with; train the policy again")
    policy = Policy(about["hidden"], about["projection"], len(about["linear_m_s"]), len(about["angular_rad_s"]))
    width = about["width"]
    template = {
        "params": fresh_params(policy, Forward(1), width, 0)["policy"],
        "scale": {"mean": jnp.zeros(width), "deviation": jnp.ones(width)},
    }
    return TrainedPolicy(policy, read_weights(run, template, about), about, networks)


def local_policy(name: str, sight: Sight, config: NavigatorConfig, *seeing: tuple[Path, Trained]) -> LocalPolicy:
    """What drives along edges.

    Args:
        seeing: the navigator's localiser and detector with their run folders; a trained policy sees through those of
            them that are adapted.
    """
    if name == PASSAGE_POLICY:
        return PassagePolicy(sight, config.passable, config.clear_m)
    return load_policy(name, *(run if "adapted_from" in network.about else None for run, network in seeing))
