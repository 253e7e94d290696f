"""Scenes of one scan, the last one of people's annotations, in; a picture of them from above and what they found out.

python -m docs.studies.scans.ladder mesh/room network/room labels/room people -o docs/ladder.webp
"""

from __future__ import annotations

import argparse
import colorsys
import dataclasses
import math
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from converters.check.pictures import Picture, world_surfaces
from converters.propose.pieces import bounds, box_iou
from converters.records.raw import TexturedMesh
from converters.segment.labelling import MATCH_IOU
from scenes_mjcf.look import over
from scenes_mjcf.schema import load_manifest

TITLES = "a  mesh only", "b  the network's labels", "c  the room's true labels", "d  people's annotations"
PANEL_PX, TITLE_PX, GAP_PX = 470, 46, 10
TINT, HUES = 0.72, {"chair": 0.07, "table": 0.58, "desk": 0.58, "basket": 0.38, "door": 0.85}
"""Share of its category's colour in what moves, and that colour's hue."""


def surfaces_of(scene: Path) -> dict[str, TexturedMesh]:
    """Body -> what is drawn of it, in the world."""
    model = mujoco.MjModel.from_xml_path(str(scene / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return world_surfaces(model, data)


def found(scene: Path, truth: Path) -> list[tuple[str, float]]:
    """For each movable of `truth`: its name, and the best box IoU of a movable of its category in `scene`."""
    surfaces, known = surfaces_of(scene), surfaces_of(truth)
    category = {o.name: o.category for o in load_manifest(scene).objects}
    return [
        (
            o.name,
            max(
                (
                    box_iou(bounds(known[o.name].vertices), bounds(surfaces[name].vertices))
                    for name, own in category.items()
                    if own == o.category
                ),
                default=0.0,
            ),
        )
        for o in load_manifest(truth).objects
    ]


def tinted(surface: TexturedMesh, hue: float) -> TexturedMesh:
    """The surface in one hue, lights and shades kept."""
    assert surface.texture is not None
    grey = surface.texture.astype(float).mean(axis=2, keepdims=True) / 255.0
    colour = np.array(colorsys.hsv_to_rgb(hue, 0.9, 1.0)) * (0.55 + 0.45 * grey)
    mixed = 255.0 * (TINT * colour + (1 - TINT) * grey)
    return dataclasses.replace(surface, texture=np.clip(mixed, 0, 255).astype(np.uint8))


def panel(scene: Path, low: np.ndarray, high: np.ndarray, title: str) -> Image.Image:
    """One scene from above: what moves in colours, the rest as it is."""
    pixel_m = float((high - low)[0]) / PANEL_PX
    picture = Picture(*over(np.eye(3), low, high, pixel_m))
    manifest = load_manifest(scene)
    names = {o.name: o.category for o in manifest.objects}
    for body, surface in surfaces_of(scene).items():
        hue = HUES.get(names[body], 0.0) if body in names else None
        picture.draw(surface if hue is None else tinted(surface, hue), one_sided=hue is None)
    rows = picture.image.shape[0]
    out = Image.new("RGB", (PANEL_PX, rows + TITLE_PX), "white")
    out.paste(Image.fromarray(picture.image[:, :PANEL_PX]), (0, TITLE_PX))
    told = f"{len(names)} movable, {manifest.floor_area_m2:.1f} m2 free"
    draw = ImageDraw.Draw(out)
    draw.text((4, 0), title, "black", ImageFont.load_default(22))
    draw.text((4, 25), told, (90, 90, 90), ImageFont.load_default(17))
    return out


def main() -> None:
    """Prints the table and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs=4, type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    for scene in arguments.scenes:
        manifest, ious = load_manifest(scene), found(scene, arguments.scenes[-1])
        passed = sum(gate["passed"] for gate in manifest.gates.values())
        met = sum(iou >= MATCH_IOU for _, iou in ious)
        told = ", ".join(f"{name} {iou:.2f}" for name, iou in ious)
        print(
            f"{scene}: {len(manifest.objects)} movable, {met} of {len(ious)} found, {manifest.floor_area_m2:.2f} m2, "
            f"{passed} of {len(manifest.gates)} gates; {told}"
        )
    room = surfaces_of(arguments.scenes[-1])["structure"].vertices[:, :2]
    low, high = room.min(axis=0) - 0.05, room.max(axis=0) + 0.05
    panels = [panel(s, low, high, t) for s, t in zip(arguments.scenes, TITLES, strict=True)]
    wide, high_px = panels[0].size
    out = Image.new("RGB", (2 * wide + GAP_PX, 2 * high_px + GAP_PX), "white")
    for k, one in enumerate(panels):
        out.paste(one, ((k % 2) * (wide + GAP_PX), math.floor(k / 2) * (high_px + GAP_PX)))
    out.save(arguments.output, quality=27, method=6)


if __name__ == "__main__":
    main()
