"""glTF: colours by value, places by value, and a line for what is not read."""

from __future__ import annotations

import base64
import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from converters.read.files import SourceFolder
from converters.read.meshes import colours_of_faces, read_surface
from converters.records.errors import SceneRejected
from converters.records.raw import TexturedMesh

TRIANGLE = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
# Upper left, upper right, lower left and lower right of the image.
RED, GREEN, BLUE, WHITE = (200, 0, 0), (0, 200, 0), (0, 0, 200), (255, 255, 255)
QUARTERS = np.array([[RED, GREEN], [BLUE, WHITE]], np.uint8)
LINEAR_HALF = 188
"""sRGB byte of half of white's light."""
BLACK, GLOSS = {"baseColorFactor": [0, 0, 0, 1]}, "KHR_materials_pbrSpecularGlossiness"
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class Glb:
    """A GLB that is put together from arrays."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": []}

    def view(self, content: bytes, stride: int = 0) -> int:
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)})
        self.tree["bufferViews"][-1] |= {"byteStride": stride} if stride else {}
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, array: Any, normalized: bool = False, stride: int = 0) -> int:
        array = np.atleast_1d(np.asarray(array))
        rows = array.reshape(len(array), -1)
        content = rows.tobytes() if not stride else b"".join(r.tobytes().ljust(stride, b"\x7f") for r in rows)
        about = {
            "bufferView": self.view(content, stride), "componentType": KINDS[array.dtype.str[1:]],
            "count": len(array), "type": ["SCALAR", "VEC2", "VEC3", "VEC4"][rows.shape[1] - 1],
        }  # fmt: skip
        self.tree["accessors"].append(about | ({"normalized": True} if normalized else {}))
        return len(self.tree["accessors"]) - 1

    def image(self, pixels: np.ndarray = QUARTERS) -> dict[str, Any]:
        """A texture, and what a material says to name it."""
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "PNG")
        images, textures = self.tree.setdefault("images", []), self.tree.setdefault("textures", [])
        images.append({"bufferView": self.view(file.getvalue()), "mimeType": "image/png"})
        textures.append({"source": len(images) - 1})
        return {"index": len(textures) - 1}

    def save(self, root: Path, attributes: dict[str, int], material: Any = None, node: Any = None, **part: Any) -> None:
        part = {"attributes": attributes, **part, **({} if material is None else {"material": 0})}
        self.tree |= {} if material is None else {"materials": [material]}
        self.tree.setdefault("meshes", [{"primitives": [part]}])
        self.tree.setdefault("nodes", [{"mesh": 0, **(node or {})}])
        self.tree.setdefault("scenes", [{"nodes": [0]}])
        self.tree["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        body = struct.pack("<II", len(text), 0x4E4F534A) + text
        body += struct.pack("<II", len(self.data), 0x4E4942) + self.data
        (root / "m.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


def read(root: Path) -> tuple[TexturedMesh, list[str]]:
    source = SourceFolder(root)
    return read_surface(source, "m.glb", ""), source.warnings


def colour(mesh: TexturedMesh) -> tuple[int, ...]:
    return tuple(int(v) for v in colours_of_faces(mesh)[0])


@pytest.mark.parametrize(
    "colours",
    [
        np.full((3, 3), 0.5, np.float32), np.full((3, 4), 0.5, np.float32),
        np.full((3, 4), 128, np.uint8), np.full((3, 3), 32768, np.uint16),
    ],
)  # fmt: skip
@pytest.mark.parametrize("material", [None, {}, {"pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 0, 1]}}])
def test_colours_of_vertices_times_the_materials(tmp_path, colours, material):
    glb = Glb()
    at = {"POSITION": glb.accessor(TRIANGLE), "COLOR_0": glb.accessor(colours, colours.dtype.kind == "u")}
    glb.save(tmp_path, at, material)
    mesh, warnings = read(tmp_path)
    quarter = 137
    expected = (LINEAR_HALF, quarter, 0) if material else (LINEAR_HALF,) * 3
    assert colour(mesh) == pytest.approx(expected, abs=1) and warnings == []


def test_trimeshs_own_files_keep_the_colours_that_trimesh_shows(tmp_path):
    solid = trimesh.creation.box((1, 1, 1))
    solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=[10, 200, 30, 255])
    solid.export(tmp_path / "m.glb")
    assert colour(read(tmp_path)[0]) == (10, 200, 30)
    solid.visual = trimesh.visual.TextureVisuals(np.zeros((8, 2)), image=Image.new("RGB", (2, 2), (10, 200, 30)))
    solid.export(tmp_path / "m.glb")
    assert colour(read(tmp_path)[0]) == (10, 200, 30)


UPPER_RIGHT = np.full((3, 2), (0.75, 0.25), np.float32)


@pytest.mark.parametrize("unit", ["f4", "u1", "u2"])
def test_texture_coordinates_of_any_kind(tmp_path, unit):
    glb = Glb()
    uv = UPPER_RIGHT if unit == "f4" else np.round(UPPER_RIGHT * np.iinfo(unit).max).astype(unit)
    at = {"POSITION": glb.accessor(TRIANGLE), "TEXCOORD_0": glb.accessor(uv, unit != "f4", 4 * (unit != "f4"))}
    glb.save(tmp_path, at, {"pbrMetallicRoughness": {"baseColorTexture": glb.image()}})
    assert colour(read(tmp_path)[0]) == GREEN


@pytest.mark.parametrize(
    ("moved", "expected"),
    [
        ({}, RED), ({"offset": [0.5, 0.0]}, GREEN), ({"scale": [1, 3]}, BLUE),
        # Counter-clockwise as the image is seen: from the left to below it, which repeats.
        ({"rotation": np.pi / 2}, BLUE), ({"rotation": np.pi / 2, "offset": [0.5, 0.0]}, WHITE),
    ],
)  # fmt: skip
def test_a_texture_with_coordinates_of_its_own_that_are_moved(tmp_path, moved, expected):
    glb = Glb()
    at = {"POSITION": glb.accessor(TRIANGLE), "TEXCOORD_0": glb.accessor(UPPER_RIGHT),
          "TEXCOORD_1": glb.accessor(np.full((3, 2), 0.25, np.float32))}  # fmt: skip
    texture = glb.image() | {"texCoord": 1, "extensions": {"KHR_texture_transform": moved}}
    glb.tree["extensionsRequired"] = glb.tree["extensionsUsed"] = ["KHR_texture_transform"]
    glb.save(tmp_path, at, {"pbrMetallicRoughness": {"baseColorTexture": texture}})
    mesh, warnings = read(tmp_path)
    assert colour(mesh) == expected and warnings == []


def test_clamped_and_mirrored_textures_and_transparency_are_reported(tmp_path):
    glb = Glb()
    attributes = {"POSITION": glb.accessor(TRIANGLE), "TEXCOORD_0": glb.accessor(UPPER_RIGHT)}
    texture = glb.image()
    glb.tree["samplers"], glb.tree["textures"][0]["sampler"] = [{"wrapS": 33071, "wrapT": 10497}], 0
    glb.save(tmp_path, attributes, {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": texture}})
    mesh, warnings = read(tmp_path)
    assert colour(mesh) == GREEN
    assert warnings == [
        "m.glb: not used: 1 clamped or mirrored textures (they repeat)",
        "m.glb: not used: 1 transparency of materials",
    ]


def test_a_factor_a_texture_and_colours_of_vertices_are_multiplied(tmp_path):
    glb = Glb()
    light = np.array([(1, 1, 1)] * 3 + [(0.5, 1, 1)] * 3, np.float32)
    at = {"POSITION": glb.accessor(np.vstack([TRIANGLE, TRIANGLE + 1])), "COLOR_0": glb.accessor(light),
          "TEXCOORD_0": glb.accessor(np.full((6, 2), 0.75, np.float32))}  # fmt: skip
    pbr = {"baseColorTexture": glb.image(), "baseColorFactor": [1, 0.5, 0, 1]}
    glb.save(tmp_path, at, {"pbrMetallicRoughness": pbr})
    colours = colours_of_faces(read(tmp_path)[0]).astype(int)
    np.testing.assert_allclose(colours, [(255, LINEAR_HALF, 0), (LINEAR_HALF, LINEAR_HALF, 0)], atol=1)


def test_many_colours_of_vertices_over_a_texture_are_close(tmp_path):
    glb = Glb()
    shade = np.repeat(np.linspace(0.2, 1.0, 60, dtype=np.float32), 3)
    at = {"POSITION": glb.accessor(np.tile(TRIANGLE, (60, 1))), "COLOR_0": glb.accessor(np.stack([shade] * 3, 1)),
          "TEXCOORD_0": glb.accessor(np.full((180, 2), 0.75, np.float32))}  # fmt: skip
    glb.save(tmp_path, at, {"pbrMetallicRoughness": {"baseColorTexture": glb.image()}})
    shown = (colours_of_faces(read(tmp_path)[0]).astype(float) / 255) ** 2.2
    np.testing.assert_allclose(shown, np.stack([shade[::3]] * 3, 1), atol=0.06)


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        ({"emissiveFactor": [0, 0, 0.5], "pbrMetallicRoughness": BLACK}, (0, 0, LINEAR_HALF)),
        ({"emissiveFactor": [0.5, 0, 0], "pbrMetallicRoughness": {"baseColorFactor": [0.6, 1, 0, 1]}}, (255, 255, 0)),
        (
            {"emissiveFactor": [0.25, 0, 0], "pbrMetallicRoughness": BLACK,
             "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2}}},
            (LINEAR_HALF, 0, 0),
        ),
        ({"extensions": {GLOSS: {"diffuseFactor": [0.5, 0, 1, 1]}}}, (LINEAR_HALF, 0, 255)),
    ],
)  # fmt: skip
def test_light_that_a_material_emits_is_added_and_gloss_has_a_colour(tmp_path, material, expected):
    glb = Glb()
    glb.save(tmp_path, {"POSITION": glb.accessor(TRIANGLE)}, material)
    assert colour(read(tmp_path)[0]) == pytest.approx(expected, abs=1)


@pytest.mark.parametrize("emits", [False, True])
def test_textures_of_gloss_are_read_and_those_of_light_are_reported(tmp_path, emits):
    glb = Glb()
    at = {"POSITION": glb.accessor(TRIANGLE), "TEXCOORD_0": glb.accessor(UPPER_RIGHT)}
    light = {"emissiveTexture": glb.image(np.full((2, 2, 3), BLUE, np.uint8)), "emissiveFactor": [1, 1, 1]}
    gloss = {"extensions": {GLOSS: {"diffuseTexture": glb.image()}}}
    glb.save(tmp_path, at, gloss | (light if emits else {}))
    mesh, warnings = read(tmp_path)
    assert colour(mesh) == GREEN and warnings == ["m.glb: not used: 1 emissive textures"] * emits


def test_quantised_and_interleaved_positions_and_turned_nodes(tmp_path):
    glb = Glb()
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, -1, 0)])
    k = glb.accessor(np.round(corners * 127).astype(np.int8), True, stride=4)
    turn = {"translation": [1, 2, 3], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)], "scale": [2, 4, -1]}
    glb.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    glb.save(tmp_path, {"POSITION": k}, node=turn)
    mesh, _ = read(tmp_path)
    np.testing.assert_allclose(mesh.vertices, [(1, 2, 3), (1, 4, 3), (5, 2, 3)], atol=1e-9)
    np.testing.assert_array_equal(mesh.faces, [[2, 1, 0]])  # mirrored


def test_what_is_not_used_is_said_once(tmp_path):
    glb = Glb()
    glb.tree |= {"animations": [{}, {}], "cameras": [{}], "extensionsUsed": ["KHR_lights_punctual"]}
    place = glb.accessor(TRIANGLE)
    line = {"attributes": {"POSITION": place}, "mode": 1, "targets": [{"POSITION": place}]}
    more = {"POSITION": place, "JOINTS_0": place, "TEXCOORD_3": place}
    glb.tree["meshes"] = [{"primitives": [{"attributes": more}, line, {"attributes": more}]}]
    glb.save(tmp_path, {})
    mesh, warnings = read(tmp_path)
    assert mesh.texture is None and len(mesh.faces) == 2
    assert warnings == [
        f"m.glb: not used: {what}" for what in (
            "2 animations", "2 attributes JOINTS_0", "2 attributes TEXCOORD_3", "1 cameras",
            "1 extension KHR_lights_punctual",
            "1 primitives other than triangles (points, lines, strips or fans)", "1 shape keys (morph targets)",
        )
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "compressed with Draco.*cli copy m.glb plain.glb'"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "compressed with meshopt.*cli copy m.glb plain.glb'"),
        ({"extensionsRequired": ["KHR_texture_basisu"]}, "needs KHR_texture_basisu, which is not read"),
        ({"extensionsRequired": ["EXT_mesh_gpu_instancing"]}, "needs EXT_mesh_gpu_instancing, which is not read"),
        ({"asset": {"version": "1.0"}}, "is glTF 1.0, expected 2.0; export it as glTF 2.0"),
        ({"nodes": [{"mesh": 0, "skin": 0, "name": "curtain"}]}, "bones move its node 'curtain'; apply the armature"),
        ({"nodes": [{"mesh": 0, "translation": [1e13, 0, 0]}]}, "not finite numbers below"),
        ({"nodes": [{"mesh": 7}]}, "not readable as a mesh"),
        ({"scenes": [{"nodes": []}]}, "holds no triangle mesh"),
        (
            {"meshes": [{"primitives": [{"attributes": {"POSITION": 1}}]}]},
            "accessor 1 is of type SCALAR, expected VEC3",
        ),
    ],
)
def test_what_cannot_be_read_is_one_line_with_a_remedy(tmp_path, change, words):
    glb = Glb()
    at = {"POSITION": glb.accessor(TRIANGLE), "_OTHER": glb.accessor(np.zeros(3, np.float32))}
    glb.tree |= change
    glb.save(tmp_path, at)
    with pytest.raises(SceneRejected, match=words):
        read(tmp_path)


def test_nodes_that_share_a_child_show_it_once(tmp_path):
    """Chains of doubled children would be 2^40 copies."""
    glb = Glb()
    glb.tree["nodes"] = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0, "children": [0]}]
    glb.save(tmp_path, {"POSITION": glb.accessor(TRIANGLE)})
    assert len(read(tmp_path)[0].faces) == 1


def test_a_text_file_with_its_data_within(tmp_path):
    data = f"data:application/octet-stream;base64,{base64.b64encode(TRIANGLE.tobytes()).decode()}"
    tree = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": 36, "uri": data}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "nodes": [{"mesh": 0}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    }  # fmt: skip
    (tmp_path / "m.gltf").write_text(json.dumps(tree))
    np.testing.assert_array_equal(read_surface(SourceFolder(tmp_path), "m.gltf", "").vertices, TRIANGLE)
    tree["buffers"][0]["uri"] = "absent.bin"
    (tmp_path / "m.gltf").write_text(json.dumps(tree))
    with pytest.raises(SceneRejected, match="names the buffer 'absent.bin', which is not there; put it there"):
        read_surface(SourceFolder(tmp_path), "m.gltf", "")
