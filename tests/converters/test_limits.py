"""Sources that ask for more time or memory than they are worth: each refused with one line, or read, in bounds.

All are read by one process of its own, which prints what came of each, the CPU seconds and its peak memory so far.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from PIL import Image

from converters.clock import peak_memory_mib
from tests.converters import tiny_raw

LARGE = 60_000
CPU_S = 15.0
"""Of each case; they take a third of it on a machine with nothing else to do."""
MEMORY_MIB = 1800
BOX = "<geometry><box><size>0.3 0.3 0.4</size></box></geometry>"
ROOM_SDF = "".join(
    f'<model name="built_{k}"><static>1</static><pose>{at}</pose><link name="l"><visual name="v"><geometry><box><size>'
    f"{size}</size></box></geometry></visual></link></model>"
    for k, (at, size) in enumerate(
        [("0 0 -0.05 0 0 0", "60 60 0.1"), ("0 30 1.2 0 0 0", "60 0.1 2.4"), ("30 0 1.2 0 0 0", "0.1 60 2.4")]
    )
)


def png(path: Path, side: int) -> Path:
    """A black image of one bit a pixel, whose side divides by 100, written without ever holding or packing it all."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return len(data).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")

    # A hundredth of its rows as a part of a DEFLATE stream that starts anew, a hundred times; then the stream's end and
    # Adler-32 of as many zeros.
    row, packer = bytes(side // 8 + 1), zlib.compressobj(1, wbits=-15)
    part = packer.compress(side // 100 * row) + packer.flush(zlib.Z_FULL_FLUSH)
    adler = (len(row) * side % 65521) << 16 | 1
    data = b"\x78\x01" + 100 * part + b"\x03\x00" + adler.to_bytes(4, "big")
    header = side.to_bytes(4, "big") * 2 + bytes([1, 0, 0, 0, 0])
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))
    return path


def hall(root: Path, side_m: float, cuts: int = 0) -> Path:
    """A room of 12 triangles, or of more."""
    mesh = trimesh.creation.box((side_m, side_m, 3.0)).apply_translation((0, 0, 1.5))
    for _ in range(cuts):
        mesh = mesh.subdivide()
    mesh.invert()
    mesh.export(root / "room.ply")
    return root / "room.ply"


def stray(root: Path) -> Path:
    vertices, faces, _ = tiny_raw.scan()
    vertices[faces[0, 0]] = (1e4, 0.0, 1.0)
    trimesh.Trimesh(vertices, faces, process=False).export(root / "room.ply")
    return root / "room.ply"


def gltf(root: Path) -> Path:
    mesh = {"primitives": [{"attributes": {"POSITION": 0}}]}
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [mesh],
    }
    tree["accessors"] = [{"componentType": 5126, "type": "VEC3", "count": 400_000_000}]
    (root / "room.gltf").write_text(json.dumps(tree))
    return root / "room.gltf"


def mjcf(asset: str = "", world: str = "") -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        if "large.png" in asset:
            png(root / "large.png", LARGE)
        (root / "home.xml").write_text(
            f'<mujoco><asset>{asset}</asset><worldbody><geom type="plane" size="40 40 1"/>{world}</worldbody></mujoco>'
        )
        return root

    return write


def attached(root: Path) -> Path:
    """Each of seven models holds the next one ten times."""
    for k in range(7):
        own = "".join(f'<frame pos="{j} 0 0"><attach model="m" body="b" prefix="p{j}_"/></frame>' for j in range(10))
        asset = f'<asset><model name="m" file="m{k + 1}.xml"/></asset>'
        body = f'<body name="b">{own if k < 6 else ""}<geom size="0.1"/></body>'
        (root / f"m{k}.xml").write_text(f"<mujoco>{asset if k < 6 else ''}<worldbody>{body}</worldbody></mujoco>")
    (root / "m0.xml").rename(root / "scene.xml")
    return root


def gibson(name: str) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        png(tiny_raw.write_gibson(root / "building") / name, LARGE)
        return root / "building"

    return write


def sdf(inner: str, models: dict[str, str] | None = None) -> Callable[[Path], Path]:
    def write(root: Path) -> Path:
        (root / "worlds").mkdir()
        (root / "worlds" / "a.world").write_text(f'<sdf version="1.6"><world name="w">{ROOM_SDF}{inner}</world></sdf>')
        for name, model in (models or {}).items():
            (root / "models" / name).mkdir(parents=True)
            (root / "models" / name / "model.sdf").write_text(
                f'<sdf version="1.6"><model name="{name}">{model}</model></sdf>'
            )
        return root

    return write


def habitat(root: Path) -> Path:
    trimesh.creation.box((60, 0.1, 60)).apply_translation((0, -0.05, 0)).export(root / "stage.glb")
    for name in ("vase", "chair"):
        trimesh.creation.box((0.2, 0.4, 0.2)).apply_translation((0, 0.2, 0)).export(root / f"{name}.glb")
    (root / "stage.stage_config.json").write_text('{"render_asset": "stage.glb"}')
    places = [[(k % 55) - 27, 1.0 if k % 10 else 0.0, (k // 55) - 27] for k in range(3000)]
    objects = [{"template_name": "vase" if k % 10 else "chair", "translation": at} for k, at in enumerate(places)]
    scene = {
        "translation_origin": "asset_local",
        "stage_instance": {"template_name": "stage"},
        "object_instances": objects,
    }
    (root / "a.scene_instance.json").write_text(json.dumps(scene))
    return root


def at(k: int, height_m: float, columns: int = 55) -> str:
    return f"{k % columns - columns // 2} {k // columns - columns // 2} {height_m} 0 0 0"


def visuals(*poses: str) -> str:
    """A link with boxes."""
    each = (f'<visual name="v{k}"><pose>{pose}</pose>{BOX}</visual>' for k, pose in enumerate(poses))
    return f'<link name="l">{"".join(each)}</link>'


def thing(k: int) -> str:
    return f"<include><name>n{k}</name><uri>model://thing</uri><pose>{at(k, 1, 71)}</pose></include>"


def chair(k: int) -> str:
    return f'<model name="chair_{k}"><pose>{at(k, 0.2)}</pose>{visuals("0 0 0 0 0 0")}</model>'


def body(k: int) -> str:
    return f'<body name="b{k}" pos="{at(k, 1, 71)[:-6]}"><geom size="0.1 0.1 0.1" type="box"/></body>'


def nested(k: int) -> str:
    return 3 * f"<include><uri>model://m{k + 1}</uri></include>"


PIXELS = "expected at most 134,217,728; make it smaller|exceeds limit of 134217728 pixels"
COPIES = "elements with their copies, expected at most 100,000"
EXTENT = "reaches from .* expected a building of at most 100 m; remove stray vertices"
READ = ""
COPY = '<replicate count="1000"><replicate count="1000"><geom size="0.1"/></replicate></replicate>'
STILL = "<static>1</static>"
CASES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "one stray vertex at 10 km": (stray, EXTENT),
    "a hall of 300 m": (lambda root: hall(root, 300.0), EXTENT),
    "a hall of 60 m": (lambda root: hall(root, 60.0), READ),
    "a scan of 40 km": (lambda root: hall(root, 4e4, 5), EXTENT),
    "an accessor without data": (gltf, "400,000,000 elements in accessors without a bufferView, expected at most"),
    "a height field": (mjcf(f'<hfield name="h" nrow="{LARGE}" ncol="{LARGE}" size="9 9 1 1"/>'), PIXELS),
    "a height field's image": (mjcf('<hfield name="h" file="large.png" size="9 9 1 1"/>'), PIXELS),
    "a texture": (mjcf(f'<texture name="t" type="2d" builtin="flat" width="{LARGE}" height="{LARGE}"/>'), PIXELS),
    "a cube": (mjcf(f'<texture name="t" builtin="flat" width="{LARGE}" height="8"/>'), PIXELS),
    "a texture's image": (mjcf('<texture name="t" type="2d" file="large.png"/>'), PIXELS),
    "a map": (gibson("floor_trav_0.png"), PIXELS),
    "copies of copies": (mjcf(world=COPY), COPIES),
    "models of models": (attached, COPIES),
    "2,500 MJCF bodies": (mjcf(world="".join(map(body, range(2500)))), READ),
    "includes of includes": (sdf(nested(-1), {f"m{k}": nested(k) for k in range(15)}), "models lie 8 deep in models"),
    "2,500 SDF models": (sdf("".join(map(thing, range(2500))), {"thing": STILL + visuals("0 0 0 0 0 0")}), READ),
    "1,000 visuals": (
        sdf(f'<model name="m">{STILL}{visuals(*(at(k, 1) for k in range(1000)))}</model>'),
        READ,
    ),
    "800 chairs": (sdf("".join(map(chair, range(800)))), "800 pieces of furniture on its floor, expected at most 500"),
    "3,000 objects of habitat": (habitat, READ),
}


@pytest.fixture(scope="module")
def told() -> dict[str, tuple[str, float, float]]:
    command = [sys.executable, "-m", "tests.converters.test_limits"]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=Path(__file__).parents[2], timeout=600, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", CASES)
def test_a_source_is_read_or_refused_in_bounds(told, name):
    said, seconds, peak_mib = told[name]
    assert re.search(CASES[name][1], said) if CASES[name][1] else said == "read", said
    assert "\n" not in said and seconds < CPU_S and peak_mib < MEMORY_MIB


def test_a_texture_too_large_costs_its_colour_only(tmp_path):
    from converters.read.files import SourceFolder
    from converters.read.obj import read_texture

    png(tmp_path / "t.png", LARGE)
    source = SourceFolder(tmp_path)
    assert read_texture(source, tmp_path / "a.mtl", "t.png") is None
    assert "decompression bomb" in source.warnings[0] and Image.MAX_IMAGE_PIXELS == 8192 * 8192


def main() -> None:
    from converters.read.source import read_source
    from converters.records.errors import SceneRejected

    found = {}
    for name in sys.argv[1:] or CASES:
        with tempfile.TemporaryDirectory() as folder:
            place, mesh = CASES[name][0](Path(folder)), {}
            if place.suffix == ".ply":
                mesh = {"up": "z", "unit": "m"}
            began = time.process_time()
            try:
                read_source(place, **mesh)  # pyright: ignore[reportArgumentType]
                said = "read"
            except SceneRejected as error:
                said = str(error)
            found[name] = (said, time.process_time() - began, peak_memory_mib())
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
