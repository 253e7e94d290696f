"""Train variables on images and labels; on an accelerator a whole epoch is one compiled program.

Images stay on the device as u8. An epoch's order and augmentation depend only on the seed and the epoch's number, so
that a resumed run gives the same result as an uninterrupted one.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import flax.linen as nn
import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import optax

from interactive_nav_common.errors import FileError, typed
from interactive_nav_common.files import write_json
from interactive_nav_common.records import Reader
from interactive_nav_common.runs import weights
from topological_nav.learn.networks import Network, augmented
from topological_nav.scenes.rendering import batched

EVALUATED, DEVICE_EVALUATED = (8, 64), (16, 64, 256)
"""Batch sizes for inference, on a CPU and on an accelerator; each call uses the smallest that suffices."""


@flax.struct.dataclass
class Learner:
    """Hold the state that an epoch changes."""

    params: Any
    batch_stats: Any
    opt_state: Any

    @classmethod
    def start(cls, variables: dict[str, Any], tx: optax.GradientTransformation) -> Self:
        """Return the state before the first update of these weights."""
        return cls(variables["params"], variables["batch_stats"], tx.init(variables["params"]))  # type: ignore[call-arg]

    @property
    def variables(self) -> dict[str, Any]:
        """Return the argument of `flax.linen.Module.apply`."""
        return {"params": self.params, "batch_stats": self.batch_stats}


Epoch = Callable[[Learner, jax.Array, Any, jax.Array], tuple[Learner, dict[str, jax.Array]]]
"""(learner, images, labels, key) -> learner and means over the epoch; compiled. Labels may be a tree of arrays."""


def variable_shapes(module: nn.Module, image_shape: tuple[int, int]) -> dict[str, Any]:
    """Return the shapes of a module's `params` and `batch_stats` without computing them."""
    key, image = jax.random.PRNGKey(0), jax.ShapeDtypeStruct((1, *image_shape, 3), jnp.uint8)
    return {"batch_stats": {}, **jax.eval_shape(lambda k, x: module.init(k, x, train=False), key, image)}


def initial(shapes: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return initial values of variables, the same on every device, without compiling a program.

    Convolutions follow He et al. 2015 (sd = sqrt(2 / fan out)), dense layers have sd = 1 / sqrt(fan in); scales and
    variances are 1, everything else is 0.
    """
    rng = np.random.default_rng(seed)

    def value(path: Any, leaf: Any) -> jax.Array:
        name, shape = path[-1].key, leaf.shape
        if name == "kernel":
            conv = len(shape) == 4
            sd = math.sqrt(2.0 / (math.prod(shape[:2]) * shape[3])) if conv else 1.0 / math.sqrt(shape[0])
            return jnp.asarray(rng.normal(0.0, sd, shape), leaf.dtype)
        assert name in ("bias", "scale", "mean", "var"), name
        return jnp.full(shape, 1.0 if name in ("scale", "var") else 0.0, leaf.dtype)

    return jax.tree_util.tree_map_with_path(value, shapes)


def with_backbone(learner: Learner, donor: dict[str, Any], fault: str = "", about: str = "") -> Learner:
    """Return the learner with the backbone of other variables (`params`, `batch_stats`); raise if shapes differ."""
    mine, theirs = learner.params["body"], donor["params"]["body"]
    shapes = [jax.tree.map(jnp.shape, tree) for tree in (mine, theirs)]
    if shapes[0] != shapes[1]:
        raise FileError(f"{fault}: its backbone differs in kind or width; {about}")
    stats = dict(learner.batch_stats)
    if "body" in stats:
        stats["body"] = donor["batch_stats"]["body"]
    return learner.replace(params={**learner.params, "body": theirs}, batch_stats=stats)


def labelled_epoch(
    network: Network, tx: optax.GradientTransformation, batch: int, smoothing: float, augment: bool, scored: int = 0
) -> Epoch:
    """Build an epoch of classification without the last, partial batch; labels: [N] i32, of passages [N, outputs]."""

    def loss_of(params, stats, images, labels, step):
        rows, key = step
        key_image, key_drop = jax.random.split(key)
        x, y, variables = images[rows], labels[rows], {"params": params, "batch_stats": stats}
        x = augmented(key_image, x, network.task == "passages") if augment else x
        logits, new = network.apply(variables, x, train=True, mutable=["batch_stats"], rngs={"dropout": key_drop})
        if network.task == "passages":
            loss = optax.sigmoid_binary_cross_entropy(logits, y.astype(jnp.float32)).mean()
            right = (logits[:, scored] > 0) == y[:, scored]
        else:
            target = optax.smooth_labels(jax.nn.one_hot(y, network.outputs), smoothing)
            loss = optax.softmax_cross_entropy(logits, target).mean()
            right = logits.argmax(1) == y
        return loss, (new.get("batch_stats", stats), {"accuracy": right.mean()})

    return descent_epoch(keyed_batches(batch), loss_of, tx)


def shuffled(key: jax.Array, count: int, batch: int) -> jax.Array:
    """Return the rows [U, batch] of an epoch's updates in random order, without the last, partial batch."""
    size = min(batch, count)
    return jax.random.permutation(key, count)[: count // size * size].reshape(-1, size)


def over(epoch: Epoch, images: Any, labels: Any) -> Callable[[Learner, int, jax.Array], Any]:
    """Return an epoch for `run_epochs` over these images and labels, which stay on the device."""
    x, y = jnp.asarray(images), jnp.asarray(labels)
    return lambda learner, _, key: epoch(learner, x, y, key)


def phase_key(seed: int, phase: int) -> jax.Array:
    return jax.random.fold_in(jax.random.PRNGKey(seed), phase)


def keyed_batches(batch: int) -> Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    """Return the steps of an epoch over images in random order: the rows of a batch and a key."""

    def steps(images, key):
        key_order, key_steps = jax.random.split(key)
        order = shuffled(key_order, len(images), batch)
        return order, jax.random.split(key_steps, len(order))

    return steps


def descent_epoch(steps: Callable[..., Any], loss_of: Callable[..., Any], tx: optax.GradientTransformation) -> Epoch:
    """Build an epoch of descent; `loss_of(params, stats, images, labels, step)` returns loss, (new stats, means)."""

    def update(learner, images, labels, step):
        grad = jax.value_and_grad(loss_of, has_aux=True)
        (loss, (stats, means)), slope = grad(learner.params, learner.batch_stats, images, labels, step)
        change, opt_state = tx.update(slope, learner.opt_state, learner.params)
        return Learner(optax.apply_updates(learner.params, change), stats, opt_state), {"loss": loss, **means}

    return compiled_epoch(steps, update)


def compiled_epoch(steps: Callable[..., Any], update: Callable[..., Any]) -> Epoch:
    """Build an epoch of updates: one program on an accelerator, one program per update on a CPU.

    XLA's CPU convolutions are about eight times slower inside a loop of the program (53 against 441 images/s for
    ResNet-18 of width 8 at 64 x 48 on two busy cores). `steps` maps images and a key to a tree of arrays [S, ...], a
    row per update.
    """
    planned, one = jax.jit(steps), jax.jit(update, donate_argnums=0)

    def whole(learner, images, labels, key):
        learner, each = jax.lax.scan(lambda state, row: update(state, images, labels, row), learner, steps(images, key))
        return learner, jax.tree.map(jnp.mean, each)

    def by_updates(learner, images, labels, key):
        rows, each = jax.device_get(planned(images, key)), []  # to cut and mean arrays of JAX costs more than to learn
        for i in range(len(jax.tree.leaves(rows)[0])):
            learner, numbers = one(learner, images, labels, jax.tree.map(lambda x, i=i: x[i], rows))
            each.append(numbers)
        return learner, jax.tree.map(lambda *x: np.mean(x), *jax.device_get(each))

    return by_updates if jax.default_backend() == "cpu" else jax.jit(whole, donate_argnums=0)


def in_batches(function: Callable[[jax.Array], jax.Array], images: np.ndarray) -> np.ndarray:
    """Return a compiled function's rows for images [N, H, W, 3]; see `rendering.batched`."""
    sizes = EVALUATED if jax.default_backend() == "cpu" else DEVICE_EVALUATED
    if not len(images):  # the shape of a row takes a call
        return np.asarray(function(jnp.zeros((sizes[0], *images.shape[1:]), images.dtype)))[:0]
    return batched(lambda part: function(jnp.asarray(part)), (images,), sizes)


def padded_size(count: int) -> int:
    """Return a power of two of at least `count`; on accelerators a power of four of at least 16, to compile less."""
    if jax.default_backend() == "cpu":
        return 1 << (count - 1).bit_length()
    return max(16, 1 << ((count - 1).bit_length() + 1) // 2 * 2)


WEIGHTS, DESCRIPTION, RESULTS = "weights.safetensors", "network.json", "results.json"
PACKED_WEIGHTS = f"{WEIGHTS}.xz"
"""File of an exported run."""


def write_network(out: Path, tensors: Any, about: dict[str, Any], precision: str = "") -> None:
    """Write weights, and their description with their digest; if a precision is given, as a packed export."""
    header = {name: about[name] for name in ("task", "parameters", "commit") if name in about}
    path = out / (PACKED_WEIGHTS if precision else WEIGHTS)
    digest = weights.write_weights(path, weights.flat(jax.device_get(tensors)), header)["digest"]
    about |= {"export": {"precision": precision, "weights_digest": digest}} if precision else {"digest": digest}
    write_json(out / DESCRIPTION, {k: v for k, v in about.items() if k != "commit"})


def weights_file(run: Path) -> Path:
    """Return the weights file of a run or an export."""
    packed = run / PACKED_WEIGHTS
    return packed if packed.is_file() else run / WEIGHTS


@dataclasses.dataclass(frozen=True)
class _Description:
    """Hold the fields that every network.json needs."""

    task: str
    digest: str
    export: dict[str, str] = dataclasses.field(default_factory=dict)


def read_description(run: Path, kind: str, task: str) -> dict[str, Any]:
    """Return the content of a finished run's network.json."""
    path = run / DESCRIPTION
    if not path.is_file():
        again = f"python -m topological_nav train {task} -o {typed(run)}"
        raise FileError(f"{run}: holds no trained {kind}; finish it: {again}")
    reader = Reader(FileError, "train again", finite=False)
    about = reader.json(path)
    reader.record(about, _Description, str(path), others=True)
    return about


def read_weights(run: Path, template: Any, about: dict[str, Any]) -> Any:
    """Return the variables of a finished run, in the template's precision."""
    path, again = weights_file(run), "train again"
    tensors, header = weights.read_weights(path, FileError, again)
    if about.get("export", {}).get("weights_digest", header["digest"]) != header["digest"]:
        raise FileError(f"{path}: is not the file that was exported with its {DESCRIPTION}; export the run again")
    variables = weights.fill(template, tensors, path, lambda: weights.flat(template), FileError, again)
    return weights.fitting(template, variables, path, FileError)
