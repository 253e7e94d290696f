"""Offer physics backends behind one interface: `warp`, `jax` and `native`; `make_physics` picks one."""

import functools
import importlib.util
import os
from typing import Any

import jax

from interactive_nav.config import NavConfig
from interactive_nav.physics.base import Physics, PhysicsState, StepSignals
from interactive_nav.scenes.world import World
from interactive_nav_common.errors import ConfigError, MissingPackage, missing
from interactive_nav_common.files import cache_folder


def resolve_backend(name: str) -> str:
    """Resolve `auto` to `warp` on an NVIDIA GPU with Warp installed, `native` on a CPU, `jax` elsewhere."""
    has_warp = importlib.util.find_spec("warp") is not None
    if name == "auto":
        platform = jax.default_backend()
        if platform == "cpu":
            return "native"
        return "warp" if platform == "gpu" and has_warp else "jax"
    if name == "warp" and not has_warp:
        raise MissingPackage(missing("backend=warp", "warp-lang", "warp", ", or choose backend=native"))
    return name


def keep_programs() -> None:
    """Keep programs that JAX compiles for an accelerator in the cache folder, or in JAX_COMPILATION_CACHE_DIR.

    Entries are named by source, device and versions; for Warp calls they hold the call, not the kernels.
    """
    chosen = "JAX_COMPILATION_CACHE_DIR" in os.environ or jax.config.jax_compilation_cache_dir
    if not chosen and jax.default_backend() != "cpu":
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "programs"))


@functools.cache
def compiler_options() -> dict[str, Any] | None:
    """Return compiler options for stepping environments with images on a CPU, else None.

    They disable YNNPACK, with which steps take a sixth to a third longer (jax issue 37465; measured by
    `docs.studies.policies.cpu_programs`).
    """
    if jax.default_backend() != "cpu":
        return None
    options: dict[str, Any] = {"xla_cpu_experimental_ynn_fusion_type": ""}
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0)
    except jax.errors.JaxRuntimeError:
        return None
    return options


def make_physics(world: World, config: NavConfig) -> Physics:
    """Build the backend that the configuration names."""
    backend = resolve_backend(config.backend)
    if config.collision == "hulls" and backend != "native":
        raise ConfigError(f"collision='hulls' with backend='{backend}', expected backend='native'; use boxes")
    if config.cone == "elliptic" and backend != "native":
        raise ConfigError(f"cone='elliptic' with backend='{backend}', expected backend='native'; use pyramidal cones")
    if backend == "native":
        from interactive_nav.physics.native import NativePhysics

        return NativePhysics(world, config)
    from interactive_nav.physics.mjx_batch import JaxPhysics, WarpPhysics

    engine = WarpPhysics if backend == "warp" else JaxPhysics
    return engine(world, config)


__all__ = ["Physics", "PhysicsState", "StepSignals", "make_physics", "resolve_backend"]
