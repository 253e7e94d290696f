"""Write a replay as a Rerun recording (.rrd), on one timeline: `time`, simulated seconds since the start.

Entities: `world/robot/BODY`, `world/objects/NAME` and `world/structure/NAME`, with their shapes; `waypoints` of the
robot's base; `world/goal` and `world/path`; `world/camera` with `rgb`, `depth` and `segmentation`; and the scalars
`reward`, `reward/TERM` and `force`, the score's F_t in N.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import trimesh

from interactive_nav.pictures.camera import GOAL_COLOUR, OUTSIDE, TRAIL_COLOUR, SceneView, robot_camera
from interactive_nav.pictures.replay import Replay
from interactive_nav.pictures.scene_model import SCENE
from interactive_nav.sensing.boxes import geom_box
from interactive_nav_common.errors import missing, optional
from interactive_nav_common.files import whole_file
from scenes_mjcf.categories import SEGMENTATIONS
from scenes_mjcf.look import geom_mesh

XYZW = [1, 2, 3, 0]
"""Rerun's order of a quaternion w x y z."""


def need_rerun() -> Any:
    """Import Rerun; raise `MissingPackage` where it is not installed."""
    return optional("rerun", missing("--rerun", "rerun-sdk", "rerun"))


def write_recording(
    replay: Replay, view: SceneView, path: Path, side: int, every: int, on_progress: Callable[[int], None]
) -> int:
    """Write a recording atomically and return its number of image sets: one every few control steps and one at the end.

    `side` is in pixels.
    """
    rr, dt_s = need_rerun(), replay.control_dt_s
    steps = [*range(0, replay.num_steps, every), replay.num_steps]
    with whole_file(path) as partial, rr.RecordingStream("interactive-nav") as stream:
        stream.save(partial)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        _log_bodies(rr, replay, view)
        _log_task(rr, replay, view)
        for count, step in enumerate(steps, 1):
            rr.set_time("time", duration=step * dt_s)
            view.place(replay.bodies, replay.body_pos_w[step], replay.body_quat_w[step])
            pose, lens = robot_camera(view, side, side, replay.image_fov_deg)
            image, axes_w = view.render(pose, lens, SCENE), pose.axes_w[:, [1, 2, 0]] * [1, -1, 1]  # right, down, ahead
            pinhole = rr.Pinhole(focal_length=1 / lens.pixel, width=side, height=side)
            rr.log("world/camera", rr.Transform3D(translation=pose.pos_w, mat3x3=axes_w), pinhole)
            rr.log("world/camera/rgb", rr.Image(image["rgb"]).compress())
            rr.log("world/camera/depth", rr.DepthImage(image["depth"], meter=1.0))
            rr.log("world/camera/segmentation", rr.SegmentationImage(image["segmentation"]))
            on_progress(count)
        stream.disconnect()
    return len(steps)


def _shape(rr: Any, view: SceneView, geom: int) -> Any:
    """Return a mesh, or the box around another geom, in its body's frame."""
    model, colour = view.model, (255 * view.colour[geom]).astype(np.uint8)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = trimesh.Trimesh(*geom_mesh(model, geom), process=False)
        parts = {"triangle_indices": mesh.faces, "vertex_normals": mesh.vertex_normals, "albedo_factor": colour}
        return rr.Mesh3D(vertex_positions=mesh.vertices, **parts)
    centre, quat, half_m = np.split(geom_box(model, geom), [3, 7])
    box = {"centers": [centre], "quaternions": [quat[XYZW]], "half_sizes": [half_m]}
    return rr.Boxes3D(**box, colors=[colour], fill_mode="solid")


def _times(rr: Any, replay: Replay, first: int) -> list[Any]:
    return [rr.TimeColumn("time", duration=np.arange(first, replay.num_steps + 1) * replay.control_dt_s)]


def _log_bodies(rr: Any, replay: Replay, view: SceneView) -> None:
    model, data = view.model, view.data
    shown = np.isin(model.geom_group, OUTSIDE) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    for body in np.unique(model.geom_bodyid[shown]).tolist():
        name = model.body(body).name
        i = replay.bodies.index(name) if name in replay.bodies else None
        kind = "structure" if i is None else "robot" if i < replay.num_robot_bodies else "objects"
        entity = rr.new_entity_path(["world", kind, name])
        for geom in np.flatnonzero(shown & (model.geom_bodyid == body)).tolist():
            rr.log(f"{entity}/{geom}", _shape(rr, view, geom), static=True)
        if i is None:
            pose = rr.Transform3D(translation=data.xpos[body], quaternion=data.xquat[body][XYZW])
            rr.log(entity, pose, static=True)
        else:
            pos_w, quat_w = replay.body_pos_w[:, i], replay.body_quat_w[:, i][:, XYZW]
            rr.send_columns(entity, _times(rr, replay, 0), rr.Transform3D.columns(translation=pos_w, quaternion=quat_w))


def _log_task(rr: Any, replay: Replay, view: SceneView) -> None:
    radius_m = replay.success_distance_m
    disc = {"centers": [[*replay.goal_xy_w, 0]], "half_sizes": [[radius_m, radius_m, 0.01]], "fill_mode": "solid"}
    rr.log("world/goal", rr.Ellipsoids3D(**disc, colors=[GOAL_COLOUR], labels=["goal"]), static=True)
    path = np.pad(replay.robot_xy_w, ((0, 0), (0, 1)))
    rr.log("world/path", rr.LineStrips3D([path], colors=[TRAIL_COLOUR]), static=True)
    classes = SEGMENTATIONS[replay.segmentation_classes]
    rows = [(i, *row) for i, row in enumerate(zip(classes.names, classes.colours, strict=True))]
    rr.log("world/camera", rr.AnnotationContext(rows), static=True)

    points = np.pad(replay.waypoints_b, ((0, 0), (0, 0), (0, 1)))
    columns = rr.Points3D.columns(positions=points.reshape(-1, 3)).partition([points.shape[1]] * len(points))
    base = rr.new_entity_path(["world", "robot", replay.bodies[0]])
    rr.send_columns(f"{base}/waypoints", _times(rr, replay, 0), columns)
    series = {"reward": replay.reward, "force": replay.force_n}
    series |= dict(zip(replay.reward_names, replay.reward_terms.T, strict=True))
    for name, values in series.items():
        rr.send_columns(name, _times(rr, replay, 1), rr.Scalars.columns(scalars=values))
