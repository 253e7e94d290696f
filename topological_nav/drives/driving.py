"""Map images to velocities along an edge, ten times a second, by two memories; and define the forward model."""

import dataclasses
import functools
import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from interactive_nav_common.errors import FileError, readable
from interactive_nav_common.files import whole_file
from interactive_nav_common.jobs.progress import Stopped
from interactive_nav_common.rows import digest_of
from interactive_nav_common.signals import stop_signals
from topological_nav.config import PASSAGE_POLICY, DriveConfig, NavigatorConfig
from topological_nav.drives.dataset import Drives, drive_images, load_drives, read_drives_header
from topological_nav.learn.learning import in_batches, initial, read_description, read_weights
from topological_nav.learn.training import SAME, Networks, Trained, camera_settings, load_networks, need_task
from topological_nav.maps.build import PassagePolicy, Sight

Memory = tuple[jax.Array, jax.Array]
"""Hidden states [B, H] of the cells for linear and angular velocity."""


class SummedCell(nn.Module):
    """Define a GRU cell (Cho et al. 2014, reset gate after the product) whose gates read a sum s of memories.

    Input x and memory h give r, z = sigmoid(W x + U s + b) and n = tanh(V x + c + r (Q s + d)); the new memory is (1 -
    z) n + z h, within (-1, 1).
    """

    hidden: int

    def setup(self) -> None:
        """Build the submodules; flax calls it."""
        self.inputs, self.memory = nn.Dense(3 * self.hidden), nn.Dense(3 * self.hidden)

    def __call__(self, hidden: jax.Array, total: jax.Array, product: jax.Array) -> jax.Array:
        """Map a memory [B, H], a sum [B, H] and the input's product [B, 3 H] by `inputs` to the new memory [B, H]."""
        from_x, from_total = (jnp.split(one, 3, -1) for one in (product, self.memory(total)))
        reset, keep = (nn.sigmoid(a + b) for a, b in zip(from_x[:2], from_total[:2], strict=True))
        new = nn.tanh(from_x[2] + reset * from_total[2])
        return (1.0 - keep) * new + keep * hidden


class Policy(nn.Module):
    """Choose velocities by one cell each; both read the sum of both memories."""

    hidden: int = 500
    projection: int = 0
    linear_classes: int = 3
    angular_classes: int = 5

    def setup(self) -> None:
        """Build the submodules; flax calls it."""
        self.project = nn.Dense(self.projection) if self.projection else None
        self.cells = [SummedCell(self.hidden), SummedCell(self.hidden)]
        self.heads = [nn.Dense(self.linear_classes), nn.Dense(self.angular_classes)]

    def __call__(self, memory: Memory, x: jax.Array) -> tuple[Memory, tuple[jax.Array, jax.Array]]:
        """Map standardised embeddings [B, D] to the next memory and logits of linear and angular classes."""
        new = self.advance(memory, self.products(x))
        return new, self.logits(new)

    def products(self, x: jax.Array) -> tuple[jax.Array, ...]:
        """Return what either cell reads of standardised embeddings [..., D]: [..., 3 H] each, without its memory."""
        if self.project is not None:
            x = nn.relu(self.project(x))
        return tuple(cell.inputs(x) for cell in self.cells)

    def advance(self, memory: Memory, products: tuple[jax.Array, ...]) -> Memory:
        """Return the next memory, given the `products` [B, 3 H] of both cells."""
        total = memory[0] + memory[1]
        return tuple(cell(hidden, total, p) for cell, hidden, p in zip(self.cells, memory, products, strict=True))  # type: ignore[return-value]

    def logits(self, memory: Memory) -> tuple[jax.Array, jax.Array]:
        """Return logits [..., L] and [..., A] of linear and angular classes, given memories [..., H]."""
        return tuple(head(h) for head, h in zip(self.heads, memory, strict=True))  # type: ignore[return-value]

    def fresh(self, batch: int) -> Memory:
        """Return the initial memory of a run."""
        return jnp.zeros((batch, self.hidden)), jnp.zeros((batch, self.hidden))


class Forward(nn.Module):
    """Predict the next embedding after an action by two layers, either its `change` or itself."""

    hidden: int = 512
    change: bool = True

    @nn.compact
    def __call__(self, u: jax.Array, x: jax.Array, action: jax.Array, deviation: jax.Array) -> jax.Array:
        """Map embeddings u [..., D], standardised ones x and actions [..., L + A] to the next embeddings.

        Actions are one-hot classes or probabilities, linear then angular; `deviation` [D] is the unit of change.
        """
        y = jnp.concatenate([x, action], -1)
        for _ in range(2):
            y = nn.relu(nn.Dense(self.hidden)(y))
        y = nn.Dense(u.shape[-1])(y)
        return u + jnp.broadcast_to(deviation, u.shape) * y if self.change else y


def standardised(u: jax.Array, scale: dict[str, jax.Array]) -> jax.Array:
    """Return embeddings [..., D] minus `mean` [D], divided by `deviation` [D]."""
    mean, deviation = (jnp.broadcast_to(scale[name], u.shape) for name in ("mean", "deviation"))
    return (u - mean) / deviation


def unrolled(policy: Policy, params: Any, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return logits [B, T, L] and [B, T, A] of runs of standardised embeddings [B, T, D] from initial memories."""

    def apply(method: str, *of: Any) -> Any:
        return policy.apply({"params": params}, *of, method=method)

    def step(memory, now):
        new = apply("advance", memory, now)
        return new, new

    # Only what a memory enters is computed step by step; on accelerators, each turn of the loop costs its launch.
    turn = 1 if jax.default_backend() == "cpu" else 10
    _, memories = jax.lax.scan(step, policy.fresh(len(x)), apply("products", x.swapaxes(0, 1)), unroll=turn)
    return tuple(value.swapaxes(0, 1) for value in apply("logits", memories))  # type: ignore[return-value]


def mean_over(values: jax.Array, mask: jax.Array) -> jax.Array:
    """Return the mean of values where the mask is true; 0 if it is false everywhere."""
    return jnp.where(mask, values, 0.0).sum() / jnp.maximum(mask.sum(), 1)


def policy_loss(
    logits: tuple[jax.Array, jax.Array],
    truth: Mapping[str, jax.Array],
    guesses: tuple[jax.Array, jax.Array],
    following: jax.Array,
    alpha: jax.Array | float,
    lam: jax.Array | float,
    jointly: jax.Array | float = 1.0,
    consistent: jax.Array | float = 0.0,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return alpha (CE_angular + CE_linear) + |u - f(u, a)|^2 + lambda |u - f(u, a_hat)|^2 and its parts, means.

    The policy's logits are [B, T, L] and [B, T, A], `truth` fields of `imitation.Sequences`, `guesses` [B, T, D]
    f(u, a) by the expert's action a and f(u, a_hat) by the policy's, `following` [B, T, D] u, the embedding of the next
    step; `jointly` 0 leaves the forward model's error alone, with the share `consistent` of the last term.
    """
    cross = [
        mean_over(optax.softmax_cross_entropy_with_integer_labels(one, truth[name]), truth["valid"])
        for one, name in zip(logits, ("linear", "angular"), strict=True)
    ]
    forward, consistency = (mean_over(jnp.square(following - u).sum(-1), truth["followed"]) for u in guesses)
    loss = forward + jointly * alpha * (cross[1] + cross[0]) + jnp.maximum(jointly, consistent) * lam * consistency
    return loss, {"ce_linear": cross[0], "ce_angular": cross[1], "forward": forward, "consistency": consistency}


def fresh_params(policy: Policy, forward: Forward, width: int, seed: int) -> dict[str, Any]:
    """Return initial weights of policy and forward model for embeddings of a `width`; the latter predicts no change."""
    key, u = jax.random.PRNGKey(0), jax.ShapeDtypeStruct((1, width), jnp.float32)
    action = jax.ShapeDtypeStruct((1, policy.linear_classes + policy.angular_classes), jnp.float32)
    shapes = {
        "policy": jax.eval_shape(lambda k, x: policy.init(k, policy.fresh(1), x), key, u)["params"],
        "forward": jax.eval_shape(lambda k, x, a: forward.init(k, x, x, a, x[0]), key, u, action)["params"],
    }
    params = initial(shapes, seed)
    last = params["forward"]["Dense_2"]
    params["forward"]["Dense_2"] = {**last, "kernel": jnp.zeros_like(last["kernel"])}
    return params


_REPORT_EVERY = 10
"""Files of images per progress report."""


@dataclasses.dataclass(frozen=True)
class Frames:
    """Hold the drives of a folder and the embeddings of their images."""

    drives: Drives
    config: DriveConfig
    header: dict[str, Any]
    features: np.ndarray
    """[F or 2 F, D] f16 of all control steps, 0 without an image; then those of mirrored images."""
    networks: Networks

    @property
    def mirrored(self) -> bool:
        """Return whether mirrored images are included."""
        return len(self.features) > len(self.drives.command)

    @classmethod
    def joined(cls, parts: Sequence["Frames"]) -> "Frames":
        """Return the frames of several folders, embedded by the same networks; the first has the settings."""
        if len(parts) == 1:
            return parts[0]
        for name in ("linear_m_s", "angular_rad_s"):
            if len(most := {getattr(part.config, name) for part in parts}) > 1:
                raise FileError(f"folders of drives have {name} = {sorted(most)}, expected one; drive again with one")
        counts = [len(part.drives.command) for part in parts]
        halves = [part.features[:count] for part, count in zip(parts, counts, strict=True)]
        halves += [part.features[count:] for part, count in zip(parts, counts, strict=True)]
        folders: list[dict[str, Any]] = []  # those that differ only in their scenes are described once
        for header in (part.header for part in parts):
            alike = next((one for one in folders if {**one, "scenes": 0} == {**header, "scenes": 0}), None)
            if alike:
                alike["scenes"] = [*alike["scenes"], *header["scenes"]]
            else:
                folders.append(dict(header))
        drives, features = Drives.joined([part.drives for part in parts]), np.concatenate(halves)
        return dataclasses.replace(parts[0], drives=drives, header={"folders": folders}, features=features)


def need_camera(folder: Path, header: Mapping[str, Any], networks: Networks) -> None:
    """Raise if a folder of drives, by its description, has another camera than the networks were trained with."""
    mine, theirs = {**header["settings"], "fov_deg": header["fov_deg"]}, camera_settings(networks.localiser)
    for name in SAME:
        if mine[name] != theirs[name]:
            raise FileError(
                f"{folder}: images have {name} = {mine[name]!r}, the networks learned from {theirs[name]!r}; drive "
                f"again with {name}={theirs[name]}"
            )


def embed_drives(folders: Sequence[Path], localiser_run: Path, detector_run: Path, mirror: bool) -> Frames:
    """Embed the images of all kept drives of one or more folders, which keep the embeddings for the next time."""
    networks = load_networks(localiser_run, detector_run, classifies=True, same=SAME)

    @jax.jit
    def sides(weights: Any, images: jax.Array) -> jax.Array:
        """Map images [N, H, W, 3] to f16 [N, 1 or 2, D]: concatenated embeddings, then those of mirrored images."""
        shown = (images, images[:, :, ::-1]) if mirror else (images,)
        return jnp.stack([embedded(networks, weights, side) for side in shown], 1).astype(jnp.float16)

    embed = functools.partial(sides, [network.variables for network in networks])
    by = [mirror, *(network.stored for network in networks)]
    with stop_signals() as stops:
        return Frames.joined([_folder_frames(Path(folder), by, networks, embed, stops) for folder in folders])


def _folder_frames(
    folder: Path, by: list[Any], networks: Networks, embed: Callable[[Any], Any], stops: list[int]
) -> Frames:
    header, config = read_drives_header(folder)
    drives = load_drives(folder)
    need_camera(folder, header, networks)
    kept = f"embedded-{digest_of([*by, hashlib.sha256(drives.pose_w.tobytes()).hexdigest()])}.npy"
    if (folder / kept).is_file():
        with readable(folder / kept, FileError, "delete it, and the images are embedded again"):
            return Frames(drives, config, header, np.load(folder / kept), networks)
    count, total, done = len(drives.command), int(drives.steps[drives.kept].sum()), 0
    features: np.ndarray | None = None
    for i, (rows, images) in enumerate(drive_images(folder)):
        at, part = drives.rows(rows), in_batches(embed, images)
        if features is None:
            features = np.zeros((part.shape[1] * count, part.shape[2]), np.float16)
        for side in range(part.shape[1]):
            features[at + side * count] = part[:, side]
        done += len(images)
        if i % _REPORT_EVERY == 0 or done == total:
            print(f"embedded {done:,} of {total:,} images of {folder}", flush=True)
        if stops:
            raise Stopped(stops[0])
    if features is None:
        raise FileError(f"{folder}: none of {len(drives)} drives was kept; drive more, or in other scenes")
    with whole_file(folder / kept) as partial, open(partial, "wb") as file:
        np.save(file, features)
    return Frames(drives, config, header, features, networks)


def embedded(networks: Sequence[Trained], weights: Any, images: jax.Array) -> jax.Array:
    """Return the concatenated embeddings [N, D] of images [N, H, W, 3] by all networks."""
    pairs = zip(networks, weights, strict=True)
    return jnp.concatenate([network.network.apply(w, images, method="embed") for network, w in pairs], -1)  # type: ignore[arg-type]


class LocalPolicy(Protocol):
    """Drive by images alone; the caller keeps the policy's state."""

    def start(self, batch: int) -> Any:
        """Return the state of `batch` new runs."""

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """Map level images [B, H, W, 3] u8 straight ahead to the new state, linear [B] m/s and angular [B] rad/s."""
        ...


class TrainedPolicy:
    """Drive by a trained `LocalPolicy`: the most likely class of either velocity at each step."""

    def __init__(self, policy: Policy, variables: dict[str, Any], about: dict[str, Any], networks: Any):
        """Store the content that `load_policy` read; compile at the first step of each batch size."""
        self.about: dict[str, Any] = about
        """Content of network.json."""
        self.networks: Networks = networks
        self._policy = policy
        data = self.networks.localiser.about["data"]
        self._shape = (data["height"], data["width"], 3)
        weights = {"policy": variables, "embedders": [n.variables for n in self.networks]}
        self._weights = jax.tree.map(jnp.asarray, weights)
        self._step = jax.jit(self._stepped)

    def start(self, batch: int) -> Any:
        """See `LocalPolicy`."""
        return jax.tree.map(np.asarray, self._policy.fresh(batch))

    def act(self, state: Any, images: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """See `LocalPolicy`."""
        if images.shape[1:] != self._shape:
            raise FileError(f"images are {images.shape[1:]}, expected {self._shape}, the size that it learned from")
        state, (linear, angular) = jax.device_get(self._step(self._weights, state, jnp.asarray(images)))
        return state, np.asarray(self.about["linear_m_s"])[linear], np.asarray(self.about["angular_rad_s"])[angular]

    def probabilities(self, images: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return probabilities of linear [T, L] and angular [T, A] classes in a run of images [T, H, W, 3] u8."""
        embeddings = np.concatenate([network.embed(images) for network in self.networks], -1)
        weights = self._weights["policy"]
        x = standardised(jnp.asarray(embeddings), weights["scale"])
        logits = unrolled(self._policy, weights["params"], x[None])
        return tuple(np.asarray(nn.softmax(one[0])) for one in logits)

    def step(self, state: Any, embedding: jax.Array, weights: Any = None) -> tuple[Any, tuple[jax.Array, ...]]:
        """Return the new state, and the most likely classes [B] of linear and angular velocity, by embeddings."""
        weights = weights or self._weights["policy"]
        x = standardised(embedding, weights["scale"])
        state, logits = self._policy.apply({"params": weights["params"]}, state, x)  # type: ignore[misc]
        return state, tuple(one.argmax(-1) for one in logits)

    def _stepped(self, weights, state, images):
        return self.step(state, embedded(self.networks, weights["embedders"], images), weights["policy"])


def load_policy(
    run_folder: Path | str, localiser: Path | str | None = None, detector: Path | str | None = None
) -> TrainedPolicy:
    """Load a finished run's policy; its networks are `localiser` and `detector`, or those named relative to the run."""
    run = Path(run_folder)
    about = read_description(run, "policy", "policy")
    need_task(about, "policy", f"{run}:")
    recorded = [run / network["run"] for network in about["networks"]]
    paths = [Path(given or there) for given, there in zip((localiser, detector), recorded, strict=True)]
    networks = load_networks(*paths, classifies=True, same=SAME)
    for network, learned in zip(networks, about["networks"], strict=True):
        if learned["digest"] not in (network.about["digest"], network.about.get("adapted_from")):
            raise FileError(f"{network.run}: is not the network that {run} learned with; train the policy again")
    policy = Policy(about["hidden"], about["projection"], len(about["linear_m_s"]), len(about["angular_rad_s"]))
    width = about["width"]
    template = {
        "params": fresh_params(policy, Forward(1), width, 0)["policy"],
        "scale": {"mean": jnp.zeros(width), "deviation": jnp.ones(width)},
    }
    return TrainedPolicy(policy, read_weights(run, template, about), about, networks)


def local_policy(name: str, sight: Sight, config: NavigatorConfig, networks: Sequence[Trained] = ()) -> LocalPolicy:
    """Return the named local policy; a trained one uses those of the networks that are adapted."""
    if name == PASSAGE_POLICY:
        return PassagePolicy(sight, config.passable, config.clear_m)
    return load_policy(name, *(n.run if "adapted_from" in n.about else None for n in networks))
