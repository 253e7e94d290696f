"""Read glTF 2.0 files: placed meshes with the colours that viewers show in even white light.

Factors and vertex colours are linear and images are sRGB, by the standard; results are sRGB. Files by trimesh are an
exception: it writes all colours as sRGB, and its default grey as the factor of every texture.
"""

import collections
import dataclasses
import io
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.color import linear_to_srgb, srgb_to_linear

from converters.read.files import SourceFolder, check_mesh
from converters.read.obj import join_textures, read_texture, textured_by_face, use_named
from converters.records.errors import NUMBERS, PIXELS, SceneRejected, check_count
from converters.records.raw import TexturedMesh
from interactive_nav_common.errors import typed
from interactive_nav_common.records import Reader
from interactive_nav_common.rotations import transformed

READ = {"KHR_materials_pbrSpecularGlossiness", "KHR_materials_unlit", "KHR_materials_emissive_strength"}
READ |= {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"}
"""Extensions; others are refused where a file requires them, and reported where it only uses them."""
COMPRESSED = {f"{by}_meshopt_compression": "meshopt" for by in ("EXT", "KHR")} | {"KHR_draco_mesh_compression": "Draco"}
USED = ("POSITION", "NORMAL", "TANGENT", "COLOR_0", "TEXCOORD_0")
"""Attributes, besides the texture coordinates that a material names."""
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES, REPEAT = 4, 10497
TRIMESH_GREY = 0.4
TINTS = 16
"""Copies of a texture, in different colours of vertices, that a primitive may need."""


@dataclasses.dataclass(frozen=True)
class _Paint:
    """What a material shows: a linear colour (3,), times a texture, and the linear light (3,) that it emits."""

    colour: np.ndarray
    emitted: np.ndarray
    image: np.ndarray | None = None
    coordinates: str = ""
    """Attribute."""
    matrix: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    """(3, 3) of the texture's coordinates, their origin at the upper left."""


def read_gltf(source: SourceFolder, path: Path) -> list[TexturedMesh]:
    """Return the meshes of the default scene in its own frame."""
    file = _File(source, path)
    meshes = file.meshes()
    source.note_counts(f"{file.where}: not used:", +file.unused, " ")
    return meshes


def to_srgb(light: np.ndarray) -> np.ndarray:
    """Return sRGB bytes of linear light; what is brighter than white is white."""
    return np.round(255 * linear_to_srgb(np.clip(light, 0.0, 1.0))).astype(np.uint8)


BYTES = srgb_to_linear(np.arange(256) / 255)


class _File:
    """A decoded file; counts what it does not use."""

    def __init__(self, source: SourceFolder, path: Path) -> None:
        self.source, self.path, self.where = source, path, source.relative(path) or path.name
        content = path.read_bytes()
        self.binary = b""
        if content[:4] == b"glTF":
            end = 20 + int.from_bytes(content[12:16], "little")
            self.binary = content[end + 8 : end + 8 + int.from_bytes(content[end : end + 4], "little")]
            content = content[20:end]
        self.tree = Reader(SceneRejected, "export it again").decoded(content, "JSON", str(path))
        self._check()
        self.buffers: dict[int, bytes] = {}
        self.images: dict[int, np.ndarray | None] = {}
        self.unused: collections.Counter[str] = collections.Counter()
        for key in ("animations", "cameras", "skins"):
            self.unused[key] += len(self.tree.get(key, []))
        self.unused["scenes besides the default one"] += max(len(self.tree.get("scenes", [])) - 1, 0)
        self.srgb = "trimesh" in str(self.tree.get("asset", {}).get("generator"))
        for name in set(self.tree.get("extensionsUsed", [])) - READ:
            self.unused[f"extension {name}"] += 1

    def _check(self) -> None:
        version = str(self.tree.get("asset", {}).get("version", "2.0"))
        if not version.startswith("2."):
            raise SceneRejected(f"{self.path}: is glTF {version}, expected 2.0; export it as glTF 2.0")
        required = set(self.tree.get("extensionsRequired", []))
        absent = any("bufferView" not in a and "sparse" not in a for a in self.tree.get("accessors", []))
        for name in sorted((set(self.tree.get("extensionsUsed", [])) if absent else required) & COMPRESSED.keys()):
            raise SceneRejected(
                f"{self.path}: is compressed with {COMPRESSED[name]}; export it without compression, or convert it "
                f"with 'npx @gltf-transform/cli copy {typed(self.path.name)} plain.glb'"
            )
        if required - READ:
            raise SceneRejected(
                f"{self.path}: needs {', '.join(sorted(required - READ))}, which is not read; export it without that "
                "extension (for KHR_texture_basisu: with PNG or JPEG textures)"
            )
        # Accessors without data are zeros, as many as they say.
        counts = [a["count"] for a in self.tree.get("accessors", []) if "bufferView" not in a]
        check_count(
            self.path, sum(map(abs, counts)), NUMBERS, "elements in accessors without a bufferView", "export it again"
        )

    def meshes(self) -> list[TexturedMesh]:
        """Return every primitive of every node that the scene shows."""
        nodes, scenes = self.tree.get("nodes", []), self.tree.get("scenes", [])
        below = {child for node in nodes for child in node.get("children", [])}
        roots = scenes[self.tree.get("scene", 0)].get("nodes", []) if scenes else set(range(len(nodes))) - below
        left, visited, meshes, faces = [(k, np.eye(4)) for k in roots], set(), [], 0
        while left:
            k, pose = left.pop()
            if k in visited:
                continue
            visited.add(k)
            pose = pose @ _pose(nodes[k])
            left += [(child, pose) for child in nodes[k].get("children", [])]
            if "mesh" not in nodes[k]:
                continue
            if "skin" in nodes[k]:
                raise SceneRejected(
                    f"{self.path}: bones move its node '{nodes[k].get('name', k)}'; apply the armature and export again"
                )
            mesh = self.tree["meshes"][nodes[k]["mesh"]]
            self.unused["shape keys (morph targets)"] += any("targets" in part for part in mesh["primitives"])
            for part in mesh["primitives"]:
                meshes += self._primitive(part, pose)
                faces += len(meshes[-1].faces) if meshes else 0
                check_count(self.path, faces, NUMBERS, "faces in its nodes", "simplify it")
        return meshes

    def _bytes(self, item: Any, what: str) -> bytes:
        """Content of a buffer or image: a data URI, or a file beside the model."""
        if item["uri"].startswith("data:"):
            with urlopen(item["uri"]) as content:
                return content.read()
        path = use_named(self.source, self.path.parent, item["uri"], self.where)
        if path is None:
            raise SceneRejected(f"{self.path}: names the {what} '{item['uri']}', which is not there; put it there")
        return path.read_bytes()

    def _view(self, k: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.tree["bufferViews"][k]
        number, start = view["buffer"], view.get("byteOffset", 0)
        if number not in self.buffers:
            buffer = self.tree["buffers"][number]
            self.buffers[number] = self._bytes(buffer, "buffer") if "uri" in buffer else self.binary
        return memoryview(self.buffers[number])[start : start + view["byteLength"]]  # type: ignore[return-value]

    def _accessor(self, k: int, width: int = 0, normalized: bool = False) -> np.ndarray:
        """Return (count, width) numbers, normalised ones as floats; with `width`, of no other width."""
        a = self.tree["accessors"][k]
        kind, columns, count = COMPONENTS[a["componentType"]], WIDTHS.get(a["type"], 0), a["count"]
        if not columns or width not in (0, columns):
            raise SceneRejected(
                f"{self.path}: accessor {k} is of type {a['type']!s:.20}, expected "
                f"{next((w for w, n in WIDTHS.items() if n == width), 'a scalar or vector')}; export it again"
            )
        if "sparse" in a:
            raise SceneRejected(f"{self.path}: accessor {k} is sparse, which is not read; export it without shape keys")
        values, row = np.zeros((count, columns), kind), np.dtype(kind).itemsize * columns
        if "bufferView" in a:
            stride = self.tree["bufferViews"][a["bufferView"]].get("byteStride", 0) or row
            if stride < row:
                raise ValueError(f"a byteStride of {stride}")
            strides = (stride, row // columns)
            values = np.ndarray(values.shape, kind, self._view(a["bufferView"]), a.get("byteOffset", 0), strides)
        if (normalized or a.get("normalized")) and values.dtype.kind in "iu":
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0)
        return values.astype(float if values.dtype.kind == "f" else np.int64)

    def _primitive(self, part: Any, pose: np.ndarray) -> list[TexturedMesh]:
        """Return a primitive's triangles as one mesh; nothing of other kinds."""
        attributes = part["attributes"]
        if part.get("mode", TRIANGLES) != TRIANGLES:
            self.unused["primitives other than triangles (points, lines, strips or fans)"] += 1
            return []
        vertices = self._accessor(attributes["POSITION"], 3).astype(float)
        index = self._accessor(part["indices"], 1)[:, 0] if "indices" in part else np.arange(len(vertices))
        faces = index[: len(index) // 3 * 3].reshape(-1, 3)
        if not len(faces):
            return []
        check_mesh(self.path, vertices, faces)
        vertices = transformed(vertices, pose)
        faces = faces[:, ::-1] if np.linalg.det(pose[:3, :3]) < 0 else faces
        check_mesh(self.path, vertices, faces)
        paint = self._material(self.tree["materials"][part["material"]]) if "material" in part else None
        for name in attributes.keys() - {paint and paint.coordinates} - set(USED):
            self.unused[f"attributes {name:.40}"] += 1
        if paint is None and "COLOR_0" not in attributes:
            return [TexturedMesh(vertices, faces, None, None)]
        light = np.ones((len(faces), 3))
        if "COLOR_0" in attributes:
            light = self._light(self._accessor(attributes["COLOR_0"], normalized=True)[:, :3])[faces].mean(axis=1)
        return [self._painted(vertices, faces, paint or _Paint(np.ones(3), np.zeros(3)), light, attributes)]

    def _light(self, colours: np.ndarray) -> np.ndarray:
        return srgb_to_linear(np.clip(colours, 0.0, 1.0)) if self.srgb else colours

    def _material(self, material: Any) -> _Paint:
        """Return what a material reflects of white light, and what it emits."""
        more = material.get("extensions", {})
        pbr, gloss = material.get("pbrMetallicRoughness", {}), more.get("KHR_materials_pbrSpecularGlossiness")
        at, factor, texture = pbr, "baseColorFactor", "baseColorTexture"
        if gloss is not None:
            at, factor, texture = gloss, "diffuseFactor", "diffuseTexture"
        alpha = pbr.get("baseColorFactor", (1.0,))[-1] < 1 or "baseColorTexture" in pbr
        self.unused["transparency of materials"] += alpha and material.get("alphaMode", "OPAQUE") != "OPAQUE"
        strength = more.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        emitted = strength * self._light(np.array(material.get("emissiveFactor", np.zeros(3)), float))
        if "emissiveTexture" in material and emitted.any():
            self.unused["emissive textures"] += 1
            emitted = np.zeros(3)
        colour = np.array(at.get(factor, np.ones(3)), float)[:3]
        if self.srgb:
            colour = np.ones(3) if texture in at and np.allclose(colour, TRIMESH_GREY) else self._light(colour)
        if texture not in at or not colour.any():
            return _Paint(colour, emitted)
        info = at[texture]
        of = self.tree["textures"][info["index"]]
        sampler = self.tree["samplers"][of["sampler"]] if "sampler" in of else {}
        modes = [sampler.get(key, REPEAT) for key in ("wrapS", "wrapT")]
        self.unused["clamped or mirrored textures (they repeat)"] += modes != [REPEAT] * 2
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        turned = trimesh.transformations.planar_matrix(moved.get("offset"), moved.get("rotation"))
        matrix = turned @ np.diag([*moved.get("scale", (1.0, 1.0)), 1.0])
        coordinates = f"TEXCOORD_{moved.get('texCoord', info.get('texCoord', 0))}"
        return _Paint(colour, emitted, self._image(of), coordinates, matrix)

    def _image(self, texture: Any) -> np.ndarray | None:
        """Return a texture's image (h, w, 3) uint8; None and a warning where it cannot be read."""
        others = [e["source"] for e in texture.get("extensions", {}).values() if "source" in e]
        k = others[0] if others and "EXT_texture_webp" in texture["extensions"] else texture.get("source", *others[:1])
        if k not in self.images:
            image = self.tree["images"][k]
            if "uri" in image and not image["uri"].startswith("data:"):
                self.images[k] = read_texture(self.source, self.path, image["uri"])
            else:
                data = self._view(image["bufferView"]) if "bufferView" in image else self._bytes(image, "image")
                try:
                    with Image.open(io.BytesIO(data)) as opened:
                        self.images[k] = np.asarray(opened.convert("RGB"))
                except Exception:  # noqa: BLE001  (Pillow raises many kinds)
                    self.source.repaired(f"{self.where}: cannot decode image {k}; the material's plain colour is taken")
                    self.images[k] = None
        return self.images[k]

    def _painted(
        self, vertices: np.ndarray, faces: np.ndarray, paint: _Paint, light: np.ndarray, attributes: Any
    ) -> TexturedMesh:
        """Return a mesh in a material's colours times the faces' own `light` (m, 3)."""
        image = paint.image
        if image is None or paint.coordinates not in attributes:
            return textured_by_face(vertices, faces, to_srgb(paint.colour * light + paint.emitted))
        uv = np.nan_to_num(self._accessor(attributes[paint.coordinates], 2).astype(float), posinf=0.0, neginf=0.0)
        uv = uv @ paint.matrix[:2, :2].T + paint.matrix[:2, 2]
        uv = np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1)[faces]
        colours, number = np.unique(np.round(255 * light), axis=0, return_inverse=True)
        most = max(1, min(TINTS, PIXELS // 4 // image[..., 0].size))
        if len(colours) > most:
            row = Image.fromarray(np.clip(np.round(255 * light), 0, 255).astype(np.uint8)[None]).quantize(most)
            colours, number = np.reshape(row.getpalette() or [], (-1, 3)), np.asarray(row)
        # A table of each channel's bytes, so that large images are looked up and not computed.
        tables = [to_srgb(BYTES[:, None] * (paint.colour * tint / 255) + paint.emitted) for tint in colours]
        images = [np.stack([table[image[..., c], c] for c in range(3)], axis=-1) for table in tables]
        return TexturedMesh(vertices, faces, *join_textures(uv, number.reshape(-1), images))


def _pose(node: Any) -> np.ndarray:
    """Return (4, 4) of a node in its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    pose = trimesh.transformations.quaternion_matrix([w, x, y, z])
    pose[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
    pose[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return pose
