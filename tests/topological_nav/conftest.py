"""One small dataset, two runs and a map of a toy scene of two rooms, made by the commands themselves and shared."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import mujoco
import pytest

from tests.toys import write_room
from topological_nav.__main__ import main

WORDS = (
    *(
        "width=32",
        "height=32",
        "supersample=1",
        "positions=60",
        "max_per_room=16",
        "num_rooms=2",
        "room_method=kmeans",
        "quality=100",
    ),
    *("passage_sources=24", "passage_length_m=1.2", "passage_lengths_m=[0.6,1.2,1.8]", "shard=4"),
)
DRIVEN = (
    *("width=32", "height=32", "supersample=1", "quality=100", "shard=3"),
    *("backend=native", "drives=10", "batch=6", "test_share=0.3"),
)
TRAINED = ("width=4", "hidden=32", "learning_rate=3e-3")


@dataclasses.dataclass(frozen=True)
class Made:
    """Where the commands wrote."""

    scene: Path
    data: Path
    rooms: Path
    passages: Path
    map: Path


def paint(folder: Path) -> None:
    """Puts panels before the walls of a 6 x 4 m toy, red on the left, green on the right: its rooms look different."""
    spec = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
    structure = next(body for body in spec.bodies if body.name == "structure")
    for side, rgba in ((-1, [0.9, 0.1, 0.1, 1]), (1, [0.1, 0.8, 0.1, 1])):
        for x, y, half_x, half_y in (
            (2.99, 0, 0.01, 2),
            (1.5, 1.99, 1.5, 0.01),
            (1.5, -1.99, 1.5, 0.01),
            (0.06, -0.5, 0.01, 1.5),
        ):
            structure.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[side * x, y, 0.6],
                size=[half_x, half_y, 0.6],
                rgba=rgba,
                contype=0,
                conaffinity=0,
                group=3,
            )
    (folder / "scene.xml").write_text(spec.to_xml(), encoding="utf-8")


@pytest.fixture(scope="session")
def painted(shared) -> Path:
    """Two rooms of 3 x 4 m joined by a gap of 1 m, a cube in each."""

    def fill(base: Path) -> None:
        blocks = (("chair", 1.4, -0.5, 5.0, 0.5), ("table", -1.5, 0.5, 10.0, 0.4))
        paint(write_room(base / "painted", (6.0, 4.0), blocks, partition=True))

    return shared("topological", fill) / "painted"


@pytest.fixture(scope="session")
def made(painted, shared) -> Made:
    """Everything the commands make of the painted scene."""

    def here(base: Path) -> Made:
        return Made(painted, base / "data", base / "rooms", base / "passages", base / "map.npz")

    def fill(base: Path) -> None:
        out = here(base)
        assert main(["data", str(painted), "-o", str(out.data), *WORDS]) == 0
        learn = ["--data", str(out.data)]
        assert main(["train", "rooms", *learn, "-o", str(out.rooms), "epochs=6", "batch=32", *TRAINED]) == 0
        words = ["network=alexnet", "epochs=40", "batch=16", "width=8", "learning_rate=1e-3"]
        assert main(["train", "passages", *learn, "-o", str(out.passages), *words]) == 0
        runs = ["--localiser", str(out.rooms), "--detector", str(out.passages)]
        assert main(["map", str(painted), *runs, "-o", str(out.map), "--route", "0", "1"]) == 0

    return here(shared("made", fill))


@pytest.fixture(scope="session")
def driven(painted, shared) -> Path:
    """Ten drives through the painted scene, in two batches."""

    def fill(base: Path) -> None:
        assert main(["data", "--drives", str(painted), "-o", str(base / "drives"), *DRIVEN]) == 0

    return shared("driven", fill) / "drives"


@pytest.fixture(scope="session")
def steered(made, driven, shared) -> Path:
    """A local policy that learned a little of those drives."""

    def fill(base: Path) -> None:
        runs = ["--data", str(driven), "--localiser", str(made.rooms), "--detector", str(made.passages)]
        words = ("hidden=16", "projection=8", "forward_hidden=8", "steps=20", "overlap_s=1.5", "batch=8", "epochs=3")
        words = [*words, "learning_rate=1e-2", "straight_kept=1", "mirror=false"]
        assert main(["train", "policy", *runs, "-o", str(base / "policy"), *words]) == 0

    return shared("steered", fill) / "policy"


@pytest.fixture(scope="session")
def exported(made, steered, shared) -> Path:
    """All of it in half precision, with the map, as a package would carry it."""

    def fill(base: Path) -> None:
        (base / "maps").mkdir()
        shutil.copyfile(made.map, base / "maps" / "painted.npz")
        runs = ["--localiser", str(made.rooms), "--detector", str(made.passages), "--policy", str(steered)]
        what = ["--maps", str(base / "maps"), "--images", str(made.data)]
        assert main(["export", *runs, *what, "-o", str(base / "weights"), "commit=toy"]) == 0

    return shared("exported", fill) / "weights"
