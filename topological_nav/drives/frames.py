"""A folder of drives and two trained networks in, the embeddings of all images of the drives out."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from topological_nav.config import DriveConfig
from topological_nav.drives.dataset import Drives, drive_images, load_drives, read_drives_header
from topological_nav.errors import ALONE, Host, RunError, Stopped
from topological_nav.learn.learning import in_batches
from topological_nav.learn.training import SAME, Trained, load_pair, seen_by

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
