"""Make a dataset of photographs of a building, taken level at known places along known headings.

FOLDER/photographs.csv   one row per photograph: file, x_m, y_m, heading_deg (leftwards from the x axis); if known
                         place, room, fov_deg (vertical), and free_m, the length of the free path ahead
       connectivity.csv  corrections of the detector by hand: from, to (places), open (yes or no)
"""

import csv
import io
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from interactive_nav import get_robot, load_scene
from interactive_nav.sensing.base import seen_through
from interactive_nav_common.errors import FileError, missing, optional, readable
from interactive_nav_common.files import whole_file, write_text
from interactive_nav_common.rows import digest_of
from scenes_mjcf.look import Lens
from topological_nav.config import PITCHES, DataConfig
from topological_nav.data.dataset import DATASET, Passages, ScenePlan, about_scene, balanced, held_out, write_plan
from topological_nav.data.folders import lens_of, numbered, write_shard
from topological_nav.scenes.space import Rooms

TABLE, NUMBERS = "photographs.csv", ("x_m", "y_m", "heading_deg", "free_m", "fov_deg")
PLACE_M, TURN_RAD = 0.25, math.radians(5.0)
"""Photographs are of one place, where the table names none, if they are no farther from its first than this. A picture
of a bag is kept where the robot has gone, or turned, so far since the last."""


def read_table(path: Path, needed: str) -> list[dict[str, Any]]:
    """Return the rows of a CSV file with the needed columns."""
    with readable(path, FileError, f"write a table with the columns {needed}"):
        columns, *rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig")))
    if not rows or set(needed.split(",")) - set(columns):
        raise FileError(f"{path}: has {len(rows)} rows of {','.join(columns)}, expected some with {needed}; add them")
    return [dict(zip(columns, row, strict=False)) for row in rows if row]


def read_photographs(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of a folder's table, each with a place and a room; unknown numbers are NaN."""
    rows, stood = read_table(folder / TABLE, "file,x_m,y_m,heading_deg"), []
    for row in rows:
        with readable(folder / TABLE, FileError, f"write {', '.join(NUMBERS)} of {row['file']} as numbers"):
            row |= {name: float(row.get(name) or "nan") for name in NUMBERS}
        if lacking := [name for name in NUMBERS[:3] if not math.isfinite(row[name])]:
            raise FileError(f"{folder / TABLE}: {row['file']} has no {lacking[0]}; write a number, or remove the row")
        at = row["x_m"], row["y_m"]
        near = next((k for k, other in enumerate(stood) if math.dist(at, other) <= PLACE_M), len(stood))
        stood += [at] if near == len(stood) else []
        row |= {"place": row.get("place") or str(near), "room": row.get("room") or "unnamed"}
    return rows


def import_photographs(folder: Path, out: Path, config: DataConfig, scene: Path | None = None) -> str:
    """Make the dataset `out` of places with all headings, named as a `scene` whose map fits it; return a summary."""
    rows, around, lens = read_photographs(folder), config.headings, lens_of(config, get_robot(config.robot))
    names = list(dict.fromkeys(row["place"] for row in rows))
    place = np.array([names.index(row["place"]) for row in rows], np.int32)
    where = np.array([[row[name] for name in NUMBERS] for row in rows])
    fov_deg = np.where(np.isnan(where[:, 4]), lens.fov_deg, where[:, 4]).tolist()
    turns, taken = where[:, 2] / 360 * around, np.full((len(names), around), -1)
    for k in np.argsort(-np.abs(turns - np.rint(turns))):  # that nearest to a heading stands at last
        taken[place[k], int(np.rint(turns[k])) % around] = k
    lacking = (taken < 0).any(1)
    whole = np.flatnonzero(~lacking)
    if not len(whole):
        raise FileError(f"{folder}: no place has photographs along all {around} headings; take more, or say headings=N")
    called = sorted({row["room"] for row in rows})
    label = np.array([called.index(rows[(place == k).argmax()]["room"]) for k in range(len(names))], np.int32)
    xy = np.array([where[place == k, :2].mean(0) for k in range(len(names))])
    rng, test = np.random.default_rng([config.seed, 21]), np.zeros(len(names), bool)
    for room in range(len(called)):
        mine = whole[label[whole] == room]
        test[mine] = held_out(len(mine), config.test_share, rng)
    judged = np.flatnonzero(np.isfinite(where[:, 3]))
    free, of = where[judged, 3:4] >= np.asarray(config.passage_lengths_m), place[judged]
    heading, nothing = np.deg2rad(where[judged, 2]), np.zeros((len(of), 0, 3))
    looks = Passages(where[judged, :2], heading, free, of, label[of], test[of], nothing)
    sides = (np.flatnonzero(test[of] == held) for held in (False, True))
    kept = np.sort(np.concatenate([balanced(side, free[:, config.passage_column], rng) for side in sides]))
    rooms, path = Rooms(xy, label, "photographs", "table"), folder / "connectivity.csv"
    plan = ScenePlan(rooms, xy[whole], label[whole], test[whole], looks.take(kept))
    ways = read_table(path, "from,to,open") if path.is_file() else []
    hand = [[row[end] for end in ("from", "to", "open")] for row in ways]
    own = {"name": folder.resolve().name, "digest": digest_of(rows, 64), "split": "photographs"}
    building: Any = load_scene(scene) if scene else SimpleNamespace(**own)
    name, about = building.name, about_scene(building, plan)
    about |= {"room_names": called, "places": [names[k] for k in whole], "by_hand": hand, "table": digest_of(rows)}
    each, of_kind = len(PITCHES) * around, {"rooms": list(np.tile(taken[whole], len(PITCHES)))}
    of_kind["passages"] = [judged[kept[first : first + each]] for first in range(0, len(kept), each)]
    with DATASET.claimed(out, DATASET.describe(config, [about])):
        write_plan(out / name, plan)
        for kind, sheets in of_kind.items():
            for path, some in numbered(out / name, kind, sheets, config.shard):
                images = [
                    np.stack([read_picture(folder / rows[k]["file"], fov_deg[k], lens) for k in sheet])
                    for sheet in some
                ]
                write_shard(path, images, config.quality)
    left_out = ", ".join(names[k] for k in np.flatnonzero(lacking)) or "none"
    return (
        f"{name}: {len(whole)} places in {len(called)} rooms ({', '.join(called)}), {len(kept)} of {len(judged)} "
        f"labelled passages (as many free as blocked), {len(hand)} paths by hand; places that lack headings: {left_out}"
    )


def read_picture(path: Path, fov_deg: float, lens: Lens) -> np.ndarray:
    """Return what a lens shows [H, W, 3] u8 of a photograph with a vertical field of view."""
    with readable(path, FileError, "take it again, or leave it out"), Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    return seen_through(pixels, fov_deg, lens)


def unpack_bag(bag: Path, out: Path) -> str:
    """Write a ROS 2 bag's photographs, of the first topic of each kind, and their table; return a summary."""
    need = missing("data --photographs BAG", "rosbags", "ros2")
    highlevel, typesys = (optional(f"rosbags.{part}", need) for part in ("highlevel", "typesys"))
    from interactive_nav.ros import messages as ros

    rows, last = [], np.full(3, np.inf)
    with readable(bag, FileError, "record it again, or restore it with 'ros2 bag reindex'", " as a ROS 2 bag"):
        store = typesys.get_typestore(typesys.Stores.ROS2_KILTED)
        with highlevel.AnyReader([bag], default_typestore=store) as reader:

            def read(*kinds: str):
                topics = [c for c in reader.connections if c.msgtype in kinds][:1]
                for connection, _, raw in reader.messages(topics) if topics else ():
                    message: Any = reader.deserialize(raw, connection.msgtype)
                    yield ros.seconds(message.header.stamp), message

            placed = list(read("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"))
            poses = [getattr(message.pose, "pose", message.pose) for _, message in placed]
            if not poses:
                raise FileError(f"{bag}: has no odometry and no poses, so no headings of its images; record /odom too")
            yaw = np.unwrap([ros.quat_yaw(pose.orientation) for pose in poses])
            xy = np.array([(pose.position.x, pose.position.y) for pose in poses])
            fov_deg = next((ros.info_lens(info).fov_deg for _, info in read("sensor_msgs/msg/CameraInfo")), "")
            for time_s, message in read("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"):
                now = np.array([np.interp(time_s, [t for t, _ in placed], column) for column in (*xy.T, yaw)])
                if abs(now - last)[2] < TURN_RAD and math.dist(now[:2], last[:2]) < PLACE_M:
                    continue
                last, file, raw = now, f"{len(rows):05d}.png", hasattr(message, "encoding")
                image = Image.fromarray(ros.image_array(message)) if raw else Image.open(io.BytesIO(message.data))
                with whole_file(out / file) as partial:
                    image.save(partial, "PNG")
                rows.append([file, *np.round([*now[:2], np.degrees(now[2]) % 360], 4), fov_deg, "", ""])
    lines = [["file", *NUMBERS[:3], "fov_deg", "room", "free_m"], *rows]
    write_text(out / TABLE, "".join(f"{','.join(map(str, line))}\n" for line in lines))
    return f"{out}: {len(rows)} photographs; label them in {TABLE}, then import them: data --photographs {out}"
