"""Frames per second of RGB, normals, depth and segmentation: sizes in, one JSON row a measurement out.

    python -m docs.studies.rendering --renderer warp rays --size 68 256 512 1024 --num-envs 1 64 1024
    python -m docs.studies.rendering --image-geometry meshes --stream rgb --size 68 --num-envs 8192 --scenes S...

Cameras stand at drawn starts of a scene and turn a little at every call, so that no frame repeats. Each stream is
measured with the frames left on the device and copied to the host. `rgb` is Lambert shading of the collision boxes
in their bodies' mean colours, or with `--image-geometry meshes` of the scenes' textured meshes; `rgb_textured` draws a
scene's visual meshes with MJX-Warp's own renderer (renderer warp only); `observation` is depth and segmentation in one
pass, without the environment around them. A row that fails (memory, for the most part) carries `error` instead of a
rate. Rows are appended to `benchmarks/results/rendering.jsonl.gz`.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import interactive_nav
from benchmarks.steps_per_second import SCENE, append_row, origin, timed
from docs.studies import command_line
from interactive_nav.sensing import build_boxes, make_renderer
from scenes_mjcf.look import CameraPose, Lens

STREAMS = ("observation", "depth", "segmentation", "normals", "rgb", "rgb_textured")
TURN_RAD = 0.1
"""Between calls."""


class Skip(Exception):
    """A combination that does not exist; says why."""


def _turned(camera: CameraPose, angle_rad: jax.Array) -> CameraPose:
    cos, sin = jnp.cos(angle_rad), jnp.sin(angle_rad)
    turn = jnp.stack([jnp.stack([cos, -sin, 0 * cos]), jnp.stack([sin, cos, 0 * cos]), jnp.asarray([0.0, 0.0, 1.0])])
    return camera._replace(axes_w=turn @ camera.axes_w)


def program(
    env: Any, state: Any, stream: str, renderer_name: str, lens: Lens, meshes: bool = False
) -> Callable[[jax.Array], jax.Array]:
    """What draws one stream of every environment, as a function of the angle by which the cameras are turned.

    Raises:
        Skip: the renderer has no such stream.
    """
    sensors, scene, qpos = env.sensors, state.info["nav"].scene_index, state.pipeline_state.qpos
    camera = jax.jit(sensors.mount.pose)(qpos)
    if stream == "rgb_textured":
        if renderer_name != "warp" or meshes:
            raise Skip("MJX-Warp's textures are drawn by warp only")
        from interactive_nav.pictures.scene_model import SCENE, SceneModel
        from interactive_nav.sensing.warp import WarpColour

        visual = SceneModel(env.robot, env.scenes[0], env.world.small_objects)
        visual.pose(env.world, 0, np.asarray(qpos[0]))
        data = visual.data
        n = len(scene)
        position = jnp.broadcast_to(jnp.asarray(data.geom_xpos, jnp.float32), (n, visual.model.ngeom, 3))
        matrix = jnp.asarray(data.geom_xmat.reshape(-1, 3, 3), jnp.float32)
        matrix = jnp.broadcast_to(matrix, (n, visual.model.ngeom, 3, 3))
        painter = WarpColour(visual.model, lens, n, list(SCENE))
        return lambda angle: painter.draw(position, matrix, _turned(camera, angle))
    boxes = build_boxes(env.world, sensors.boxes.classes, colours=stream in ("rgb", "normals"))
    renderer = make_renderer(boxes, lens, renderer_name, env.backend, env.world if meshes else None)

    @jax.jit
    def draw(scene, qpos, camera, angle):
        camera = _turned(camera, angle)
        if stream in ("observation", "depth", "segmentation"):
            depth, ids = renderer.render_batch(scene, qpos, camera)
            return {"observation": (depth, ids), "depth": depth, "segmentation": ids}[stream]
        seen = renderer.images_batch((stream,), scene, qpos, camera)[stream]
        return seen if stream == "normals" else jnp.round(255.0 * seen).astype(jnp.uint8)

    return lambda angle: draw(scene, qpos, camera, angle)


def measure(draw: Callable[[jax.Array], Any], num_envs: int, to_host: bool, seconds: float) -> dict[str, float]:
    """Rate of calls that follow each other for `seconds`, after one that is not counted."""
    out, first_s = timed(draw, jnp.float32(0.0))
    nbytes = sum(x.nbytes for x in jax.tree.leaves(out))
    calls, clock = 0, time.perf_counter()
    while calls < 3 or time.perf_counter() - clock < seconds:
        out = draw(jnp.float32(TURN_RAD * (calls + 1)))
        jax.tree.map(np.asarray, out) if to_host else jax.block_until_ready(out)
        calls += 1
    took = time.perf_counter() - clock
    return {
        "frames_per_s": round(calls * num_envs / took, 1),
        "first_call_s": round(first_s, 2),
        "calls": calls,
        "bytes_per_frame": nbytes // num_envs,
    }


def main(argv: list[str] | None = None) -> int:
    """Measures and appends rows."""
    parser = command_line(__doc__, "rendering")
    parser.add_argument("--scenes", nargs="+", default=[SCENE])
    parser.add_argument("--renderer", nargs="+", choices=("auto", "warp", "rays"), default=["auto"])
    parser.add_argument("--image-geometry", choices=("boxes", "meshes"), default="boxes")
    parser.add_argument("--size", type=int, nargs="+", default=[68, 256, 512, 1024], help="side of the frames, pixels")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1])
    parser.add_argument("--stream", nargs="+", choices=STREAMS, default=list(STREAMS))
    parser.add_argument("--where", nargs="+", choices=("device", "host"), default=["device", "host"])
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--max-megapixels", type=float, default=512.0, help="a call; larger ones are left out")
    args = parser.parse_args(argv)
    env = interactive_nav.make("turtlebot", args.scenes, backend="native")
    common = {
        "scenes": args.scenes,
        "geometry": args.image_geometry,
        "boxes": env.sensors.boxes.num_boxes,
        **origin(args.commit),
    }
    append = functools.partial(append_row, args.out, hidden=("versions", "scenes"))
    for num_envs in args.num_envs:
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), num_envs))
        for renderer in args.renderer:
            for size in args.size:
                for stream in args.stream:
                    if num_envs * size * size > 1e6 * args.max_megapixels:
                        continue
                    lens = Lens(size, size, env.sensors.lens.fov_deg)
                    row = {"renderer": renderer, "stream": stream, "size": size, "num_envs": num_envs}
                    try:
                        draw = program(env, state, stream, renderer, lens, args.image_geometry == "meshes")
                        for where in args.where:
                            measured = measure(draw, num_envs, where == "host", args.seconds)
                            append(row | {"frames_on": where} | measured | common)
                    except Skip:
                        continue
                    except Exception as error:  # noqa: BLE001  (one size that does not fit must not end the others)
                        text = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
                        append(row | {"error": text[:300]} | common)
                    # Programs hold their buffers until they are dropped.
                    draw = None
                    jax.clear_caches()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
