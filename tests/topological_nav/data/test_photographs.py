"""Photographs of a building: the table that they come with, the dataset, the map, and what is refused."""

import csv
import math

import numpy as np
import pytest
from PIL import Image

from interactive_nav.scenes.scene import load_scene
from topological_nav.__main__ import main
from topological_nav.config import DataConfig
from topological_nav.data.dataset import load_passages, load_plan, load_rooms
from topological_nav.data.photographs import import_photographs, read_photographs, unpack_bag
from topological_nav.maps.graph import load_map

SMALL = DataConfig(width=32, height=32, headings=6, quality=100, passage_length_m=1.0, passage_lengths_m=(0.5, 1.0))
PLACES = {"desk": (0.0, 0.0), "door": (1.0, 0.0), "sink": (2.0, 0.0), "sofa": (4.0, 0.0)}


def shot(place, turn):
    """Each photograph has its own colour."""
    return np.full((32, 32, 3), (10 * list(PLACES).index(place) + 5, 40 * turn, 200), np.uint8)


def write(folder, drop=(), **change):
    """Six photographs a place, 3 degrees off their headings; the way is free for 1.5 m along even ones, else 0.7 m."""
    folder.mkdir()
    rows = []
    for place, (x, y) in PLACES.items():
        for turn in range(6):
            Image.fromarray(shot(place, turn)).save(folder / f"{place}{turn}.png")
            row = {"file": f"{place}{turn}.png", "x_m": x, "y_m": y, "heading_deg": 60 * turn + 3, "place": place}
            row |= {"room": "kitchen" if place == "sink" else "hall", "free_m": 0.7 if turn % 2 else 1.5, **change}
            rows.append({name: value for name, value in row.items() if name not in drop})
    with open(folder / "photographs.csv", "w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return folder


def test_images_labels_and_rooms_are_those_of_the_table(tmp_path):
    said = import_photographs(write(tmp_path / "home"), tmp_path / "data", SMALL)
    assert said.startswith("home: 4 places in 2 rooms (hall, kitchen), 24 of 24 labelled")
    rooms, passages = load_rooms(tmp_path / "data"), load_passages(tmp_path / "data")
    assert rooms.label.tolist() == [0, 0, 1, 0] and rooms.xy_w.tolist() == [list(xy) for xy in PLACES.values()]
    for k, place in enumerate(PLACES):
        assert (rooms.images[k] == [[shot(place, turn) for turn in range(6)]] * 3).all()
    assert passages.free.tolist() == [[True, turn % 2 == 0] for _ in PLACES for turn in range(6)]
    assert (passages.images[8] == shot("door", 2)).all()
    plan = load_plan(tmp_path / "data", "home")
    assert np.rad2deg(plan.passages.heading_rad[:6]) == pytest.approx([3, 63, 123, 183, 243, 303])
    # Of the hall's three places one is for testing, with its passages; the kitchen has but one place.
    assert rooms.test.sum() == 1 and not rooms.test[2] and (passages.test == np.repeat(rooms.test, 6)).all()


def test_places_without_names_are_those_that_stand_together(tmp_path):
    folder = write(tmp_path / "home", drop=("place",))
    table = folder / "photographs.csv"
    table.write_text(
        table.read_text().replace("desk3.png,0.0", "desk3.png,0.2").replace("desk4.png,0.0", "desk4.png,0.3")
    )
    assert [row["place"] for row in read_photographs(folder)][:8] == ["0", "0", "0", "0", "1", "0", "2", "2"]
    # The first place lacks its fifth heading now, the second all but that one.
    said = import_photographs(folder, tmp_path / "data", SMALL)
    assert "3 places" in said and said.endswith("places that lack headings: 0, 1")


def test_a_wider_camera_is_cut_to_the_lens(tmp_path):
    folder = write(tmp_path / "home", fov_deg=2 * math.degrees(math.atan(2.0)))
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[16:48, 16:48] = 255  # what 90 degrees show of it
    for path in folder.glob("*.png"):
        Image.fromarray(picture).save(path)
    config = DataConfig(width=32, height=32, headings=6, quality=100, fov_deg=90.0)
    import_photographs(folder, tmp_path / "data", config)
    assert load_rooms(tmp_path / "data").images.min() == 255


def refused(capsys, *words):
    """Return the one line that a command says."""
    capsys.readouterr()
    assert main([*map(str, words)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    return line


def test_bad_tables_are_refused_in_one_line(tmp_path, capsys):
    def line(folder):
        return refused(
            capsys, "data", "--photographs", folder, "-o", tmp_path / "out", "headings=6", "width=32", "height=32"
        )

    assert "photographs.csv: no such file" in line(tmp_path / "none")
    assert "expected some with file,x_m,y_m,heading_deg; add them" in line(write(tmp_path / "a", drop=("heading_deg",)))
    assert "desk0.png has no heading_deg; write a number" in line(write(tmp_path / "b", heading_deg=""))
    assert "write x_m, y_m, heading_deg, free_m" in line(write(tmp_path / "c", heading_deg="north"))
    assert "no place has photographs along all 6 headings" in line(write(tmp_path / "d", heading_deg=90))
    folder = write(tmp_path / "e")
    (folder / "sink2.png").write_bytes((folder / "sink2.png").read_bytes()[:40])
    assert "sink2.png: not readable" in line(folder)
    (folder / "connectivity.csv").write_text("from,to\ndesk,sink\n")
    assert "has 1 rows of from,to, expected some with from,to,open" in line(folder)


def test_a_home_with_one_room_or_no_passage_cannot_teach_either(tmp_path, capsys):
    said = import_photographs(write(tmp_path / "home", drop=("room", "free_m")), tmp_path / "data", SMALL)
    assert said.startswith("home: 4 places in 1 rooms (unnamed), 0 of 0")
    for task, why in (("rooms", "has one room"), ("passages", "has no passages to learn from")):
        assert why in refused(capsys, "train", task, "--data", tmp_path / "data", "-o", tmp_path / task)


def test_a_map_of_photographs_obeys_the_hand(made, tmp_path, capsys):
    folder, rooms, lines = tmp_path / "flat", load_rooms(made.data), ["file,x_m,y_m,heading_deg,place"]
    folder.mkdir()
    for k, (x, y) in enumerate(rooms.xy_w):
        for turn, image in enumerate(rooms.images[k, 1]):
            Image.fromarray(image).save(folder / f"{k}-{turn}.png")
            lines.append(f"{k}-{turn}.png,{x},{y},{20 * turn},{k}")
    (folder / "photographs.csv").write_text("\n".join(lines))
    size = ["width=32", "height=32", "quality=100", "passage_length_m=1.2", "passage_lengths_m=[0.6,1.2,1.8]"]

    def mapped(name, *scene):
        assert main(["data", *scene, "--photographs", str(folder), "-o", str(tmp_path / name), *size]) == 0
        return ["adapt", "map", "--target", tmp_path / name, "--localiser", made.rooms, "--detector", made.passages]

    words = [*mapped("plain", str(made.scene)), "domain=clean", "-o", tmp_path / "a.npz"]
    assert main([*map(str, words)]) == 0
    plain = load_map(tmp_path / "a.npz", load_scene(made.scene).digest)
    assert plain.xy_w == pytest.approx(rooms.xy_w, abs=1e-5) and plain.embeddings.shape[1] == 18
    shut, opened = plain.edges[plain.p.argmax()].tolist(), plain.edges[plain.p.argmin()].tolist()
    hand = folder / "connectivity.csv"
    hand.write_text(f"from,to,open\n{shut[0]},{shut[1]},no\n{opened[0]},{opened[1]},yes\n")
    words = mapped("hand")
    assert "say domain=clean" in refused(capsys, *words)
    assert main([*map(str, words), "domain=clean", "-o", str(tmp_path / "b.npz")]) == 0
    expected, by_hand = plain.p.copy(), load_map(tmp_path / "b.npz")
    for ends, p in ((shut, 0.0), (opened, 1.0)):
        expected[(np.sort(plain.edges, 1) == sorted(ends)).all(1)] = p
    assert by_hand.scene == "flat" and by_hand.p == pytest.approx(expected, abs=1e-6)
    hand.write_text("from,to,open\n0,cellar,yes\n")
    assert "connectivity.csv has 0,cellar,yes, expected two" in refused(capsys, *mapped("wrong"), "domain=clean")
    size.append("fov_deg=90")
    assert "photographs are stored with fov_deg=90; import them with fov_deg=120" in refused(
        capsys, *mapped("narrow"), "domain=clean"
    )
    words[3] = made.data
    assert "is no dataset of photographs; name the scene folder" in refused(capsys, *words, "domain=clean")


def record(path, poses=True):
    """Record a robot that turns at (1, 2) by 4 degrees a picture, and then goes on by 0.2 m a picture."""
    rosbag2, typesys = pytest.importorskip("rosbags.rosbag2"), pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_KILTED)
    kinds = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    steps = [(1.0, 2.0, 4.0 * k) for k in range(11)] + [(1.0 + 0.2 * k, 2.0, 40.0) for k in range(1, 4)]
    names = ["sensor_msgs/msg/Image", "geometry_msgs/msg/PoseStamped"][: 1 + poses]
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        topics = [writer.add_connection(f"/{k}", name, typestore=store) for k, name in enumerate(names)]
        for k, (x, y, degrees) in enumerate(steps):
            header = kinds["Header"](stamp=kinds["Time"](sec=k, nanosec=0), frame_id="map")
            half, data = math.radians(degrees) / 2, np.full(48, k, np.uint8)
            turn = kinds["Quaternion"](x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))
            pose = kinds["Pose"](position=kinds["Point"](x=x, y=y, z=0.0), orientation=turn)
            image = kinds["Image"](header, 4, 4, "rgb8", 0, 12, data)
            for topic, name, message in zip(topics, names, (image, kinds["PoseStamped"](header, pose)), strict=False):
                writer.write(topic, k, store.serialize_cdr(message, name))
    return path


def test_a_bag_becomes_photographs_where_the_robot_has_turned_or_gone_on(tmp_path):
    assert "7 photographs" in unpack_bag(record(tmp_path / "bag"), tmp_path / "out")
    rows = read_photographs(tmp_path / "out")
    # Every second picture of the turn, then the one 0.4 m on; 0.2 m more is not far enough.
    expected = [*((1.0, 2.0, 8.0 * k) for k in range(6)), (1.4, 2.0, 40.0)]
    assert [(row["x_m"], row["y_m"], row["heading_deg"]) for row in rows] == [pytest.approx(one) for one in expected]
    assert np.asarray(Image.open(tmp_path / "out" / "00001.png"))[0, 0].tolist() == [2, 2, 2]


def test_bags_that_are_cut_short_or_lack_poses_are_refused(tmp_path, capsys):
    [file] = record(tmp_path / "bag").glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    line = refused(capsys, "data", "--photographs", tmp_path / "bag", "-o", tmp_path / "out")
    assert "not readable as a ROS 2 bag" in line and "ros2 bag reindex" in line
    blind = record(tmp_path / "blind", poses=False)
    assert "has no odometry and no poses" in refused(capsys, "data", "--photographs", blind, "-o", tmp_path / "out")
