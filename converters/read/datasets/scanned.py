"""Read a scene of a published scan collection into a `RawScene` with NYU40 labels, through the package scenezoo.

The source is the scene's folder where the collection's download put it. scenezoo may download tables of classes.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np

from converters.read.files import SourceFolder
from converters.read.gibson import read_licence
from converters.read.homes.parts import by_last_words, category_of
from converters.read.obj import TexturedMesh, scan_of
from converters.read.surfaces import find_up, floor_level, label_storeys, turn_upright
from converters.records.errors import SceneRejected
from converters.records.raw import STRUCTURE_LABELS, UNLABELLED, RawScene
from interactive_nav_common.errors import missing, optional, readable
from interactive_nav_common.records import read_packaged

NYU40 = read_packaged(Path(__file__).with_name("nyu40.yaml"), dict[str, int])
"""Name, without what lies between its words -> id: NYU40's own, then those that collections use for the same."""
PROP = 40


@dataclasses.dataclass(frozen=True)
class Collection:
    """Where a collection's scenes lie, and how scenezoo is asked for NYU40's classes or the nearest to them."""

    name: str
    """scenezoo's."""
    levels: int
    """Folders between the collection's and a scene's."""
    marks: tuple[str, ...]
    """Files, one of which shows that a folder is such a scene; they are hashed. `*` stands for anything."""
    options: dict[str, Any] = dataclasses.field(default_factory=dict)


COLLECTIONS = read_packaged(Path(__file__).with_suffix(".yaml"), dict[str, Collection])


def read_scan(name: str, root: Path, strict: bool = False) -> RawScene:
    """Read the folder of one scene."""
    source, about = SourceFolder(root, strict), COLLECTIONS[name]
    library = optional("scenezoo", missing(f"{root}: {name}", "scenezoo", "datasets"), SceneRejected)
    for path in sorted(p for mark in about.marks for p in root.glob(mark)):
        source.use(source.inside(path), "")
    scene = root.resolve()
    with readable(root, SceneRejected, "fetch it again", f" as {name}"):
        dataset = library.get_dataset(about.name, scene.parents[about.levels - 1])
        mesh = dataset.get_mesh(scene.name)
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.triangles, np.int64)
        colours = np.asarray(mesh.vertex_colors, float) if mesh.has_vertex_colors() else None
        given = None
        try:
            given = dataset.get_segmentation(scene.name, **about.options)
        except (FileNotFoundError, library.UnsupportedOperationError) as error:  # the collection does not publish them
            why = " ".join(str(error).split())[:200]
            source.note(f"{scene.name}: has no labels ({why}); shape decides what is structure")
    if not len(faces) or not np.isfinite(vertices).all():
        raise SceneRejected(f"{root}: its mesh has {len(faces)} faces or vertices that are no numbers; fetch it again")
    root = scene
    turn = turn_upright(find_up(vertices, faces, str(root)))
    if not np.allclose(turn, np.eye(3), atol=0.02):
        vertices = vertices @ turn.T
        source.note(f"{root.name}: turned so that its floor is level")
    floor_m = floor_level(vertices, faces, str(root))
    labels = label_storeys(vertices, faces, (floor_m,))
    if given is not None:
        labels = _of_vertices(source, given, len(vertices), faces)
        unknown = sorted({n for n in given.id_to_name.values() if label_of(n) == PROP and n.lower() not in NYU40})
        if unknown:
            more = f" and {len(unknown) - 8} more" if len(unknown) > 8 else ""
            source.note(f"classes that NYU40 has no name for, taken as otherprop: {', '.join(unknown[:8])}{more}")
    scan = scan_of(TexturedMesh(vertices, faces, None, None), labels)
    if colours is not None:
        scan = dataclasses.replace(scan, vertex_colours=np.clip(np.round(255 * colours), 0, 255).astype(np.uint8))
    return source.scene(name, scan, name=root.name, floor_height_m=floor_m, licence=read_licence(source))


def label_of(name: str) -> int:
    """Return the NYU40 id of a class's name, by its last words: an office chair is a chair."""
    words = [w for w in re.findall(r"[a-z]+", name.lower()) if len(w) > 1]
    category = category_of(name)
    default = category.labels[0] if category is not None and category.labels else PROP
    return by_last_words(words, NYU40) or default


def _of_vertices(source: SourceFolder, given: Any, count: int, faces: np.ndarray) -> np.ndarray:
    """Return the (n,) NYU40 id of each vertex."""
    labels = np.asarray(given.labels)
    labels = labels if labels.ndim == 1 else labels[:, 0]
    wanted = count if given.domain == "vertex" else len(faces)
    if given.domain not in ("vertex", "face") or len(labels) != wanted:
        raise SceneRejected(f"{source.root}: {len(labels)} labels a {given.domain}, expected {wanted}; fetch it again")
    ids, at = np.unique(labels, return_inverse=True)
    named = [label_of(given.id_to_name[i]) if i in given.id_to_name else UNLABELLED for i in ids.tolist()]
    nyu = np.array(named, np.int64)[at]
    if given.domain == "vertex":
        return nyu
    # A vertex takes the label of the structure that meets there, else of any face: furniture ends at its own faces.
    out = np.zeros(count, np.int64)
    for structural in (False, True):
        mine = np.isin(nyu, STRUCTURE_LABELS) == structural
        out[faces[mine].ravel()] = np.repeat(nyu[mine], 3)
    return out
