"""`python -m docs.studies.policies.cpu_programs [SCENE]`: CPU time of XLA's programs on a CPU, by how they are made.

The paper's three convolutions within a loop: XLA's own, as one product of matrices each, and what the learners take
(`train.learners.networks.conv_for_cpu`): the product where gradients are wanted, and XLA's where not. Once XLA's own
gradients are as fast, the other two can go. And a step with images, with XLA's YNNPACK and without
(`interactive_nav.physics.compiler_options`): once it costs nothing, the option can go.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from interactive_nav.physics import compiler_options
from train.learners.networks import conv_as_product, conv_for_cpu

STEPS, IMAGES, REPEATS, ENVS = 4, 128, 3, 128


def own(images: jax.Array, kernel: jax.Array, strides: tuple[int, ...]) -> jax.Array:
    """XLA's convolution and gradients."""
    return jax.lax.conv_general_dilated(images, kernel, strides, "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def cpu_ms(conv: Callable[..., Any], gradient: bool) -> float:
    """CPU time of a step of the loop, the least of several; ms."""
    draw = np.random.default_rng(0)
    shapes = ((8, 8, 2, 32), (4, 4, 32, 64), (3, 3, 64, 64))
    kernels = [draw.normal(size=shape).astype(np.float32) for shape in shapes]
    images = draw.random((IMAGES, 68, 68, 2), np.float32)

    def features(kernels: Any, images: Any) -> Any:
        for kernel, stride in zip(kernels, (4, 2, 1), strict=True):
            images = jax.nn.relu(conv(images, kernel, (stride, stride)))
        return (images**2).mean()

    def step(carry: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        if gradient:
            found = sum(g.sum() for g in jax.grad(features)(kernels, images + carry))
        else:
            found = features(kernels, images + carry)
        return 1e-9 * jnp.asarray(found), jnp.asarray(found)

    loop = jax.jit(lambda: jax.lax.scan(step, jnp.float32(0.0), None, length=STEPS))
    return 1e3 * least_s(loop) / STEPS


def least_s(program: Callable[[], Any]) -> float:
    """CPU time of a call, the least of several after the first; s."""
    jax.block_until_ready(program())
    took = []
    for _ in range(REPEATS):
        began = time.process_time()
        jax.block_until_ready(program())
        took.append(time.process_time() - began)
    return min(took)


def step_us(scene: str, options: dict[str, Any] | None) -> float:
    """CPU time of an environment's step with depth and segmentation, `ENVS` at a time and driven at random; us."""
    seen = ("waypoints", "goal", "velocity", "depth", "segmentation")
    env = interactive_nav.make("turtlebot", [scene], backend="native", num_objects=4, observations=seen)
    began = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), ENVS))

    def one(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        action = jax.random.uniform(key, (ENVS, env.action_size), minval=-1.0, maxval=1.0)
        state = jax.vmap(env.step)(state, action)
        return state, state.reward.sum()

    keys = jax.random.split(jax.random.PRNGKey(1), 5 * STEPS)
    program = jax.jit(lambda: jax.lax.scan(one, began, keys), compiler_options=options)
    return 1e6 * least_s(program) / (len(keys) * ENVS)


def main() -> None:
    """Prints a line for each way."""
    print(f"{IMAGES} images of 68 x 68 x 2, ms of CPU time a step of a loop: acting, gradient")
    ways: dict[str, Any] = {"XLA's own": own, "as products": conv_as_product, "the learners'": conv_for_cpu}
    for name, conv in ways.items():
        print(f"{name:14} {cpu_ms(conv, False):8.1f} {cpu_ms(conv, True):8.1f}")
    scene = sys.argv[1] if len(sys.argv) > 1 else "scenes_mjcf/alder"
    print("a step with depth and segmentation, us of CPU time: with YNNPACK, without")
    print(*(f"{step_us(scene, options):8.1f}" for options in (None, compiler_options())))


if __name__ == "__main__":
    main()
