"""`python -m docs.studies.sensors SCENE -o sensors.webp`: a scene folder in, its four streams, two by two, out."""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

import interactive_nav
from interactive_nav.pictures.camera import ENGINES, STREAMS, VIEWS, PictureCamera
from interactive_nav.sensing.boxes import PALETTES
from scenes_mjcf.categories import SEGMENTATIONS

_GAP_PX, _LABEL_PX, _SWATCH_PX = 8, 44, 12
DEPTH_RANGE_M = 5.0


def as_rgb(stream: str, image: np.ndarray, depth_range_m: float = DEPTH_RANGE_M) -> np.ndarray:
    """A stream's picture for the eye, [H, W, 3] u8: near is bright, nothing is white; classes in the palette's colours.

    Args:
        stream: rgb, normals, depth or segmentation.
        image: as `PictureCamera.frame` gives it.
        depth_range_m: depth at which grey ends.
    """
    if stream == "rgb":
        return image
    if stream == "normals":
        return np.where(image.any(-1, keepdims=True), 127.5 * (image + 1), 255).astype(np.uint8)
    if stream == "depth":
        grey = np.where(image > 0, 1 - 0.9 * np.clip(image / depth_range_m, 0, 1), 1.0)
        return np.repeat((255 * grey).astype(np.uint8)[..., None], 3, -1)
    return (255 * PALETTES[4][image]).astype(np.uint8)


def legend(stream: str, image: np.ndarray, width_px: int) -> Image.Image:
    """What stands below a stream's picture: its name, and what its colours mean."""
    strip = Image.new("RGB", (width_px, _LABEL_PX), "white")
    draw = ImageDraw.Draw(strip)
    unit = {"depth": ", m", "segmentation": ", class", "normals": ", camera frame: right, up, to the viewer as R, G, B"}
    draw.text((2, 3), stream + unit.get(stream, ""), fill="black", font_size=13)
    if stream == "depth":
        grey = as_rgb(stream, np.linspace(1e-3, DEPTH_RANGE_M, width_px // 2, dtype=np.float32)[None])
        strip.paste(Image.fromarray(np.repeat(grey, _SWATCH_PX, 0)), (20, 25))
        draw.text((4, 23), "0", fill="black", font_size=13)
        draw.text((width_px // 2 + 26, 23), f"{DEPTH_RANGE_M:g}; white: nothing", fill="black", font_size=13)
    if stream == "segmentation":
        x = 4
        names, colours = SEGMENTATIONS[4].names, (255 * PALETTES[4]).astype(int)
        for k in (k for k in np.unique(image) if 0 < k < len(names)):
            draw.rectangle((x, 25, x + _SWATCH_PX, 25 + _SWATCH_PX), fill=tuple(colours[k].tolist()))
            draw.text((x + _SWATCH_PX + 4, 23), names[k], fill="black", font_size=13)
            x += _SWATCH_PX + 16 + round(draw.textlength(names[k], font_size=13))
    return strip


def main(argv: list[str] | None = None) -> int:
    """Draws one picture."""
    parser = argparse.ArgumentParser(prog="python -m docs.studies.sensors", description=__doc__)
    parser.add_argument("scene", help="scene folder")
    parser.add_argument("-o", "--out", required=True, type=Path)
    parser.add_argument("--robot", default="turtlebot")
    parser.add_argument("--seed", type=int, default=0, help="of the episode whose start is shown")
    parser.add_argument("--size", type=int, default=256, help="side of each picture, pixels")
    parser.add_argument("--view", choices=VIEWS, default="robot")
    parser.add_argument("--engine", choices=ENGINES, default="auto", help="of RGB")
    args = parser.parse_args(argv)
    env = interactive_nav.make(args.robot, [args.scene], backend="native")
    state = jax.jit(env.reset)(jax.random.PRNGKey(args.seed))
    frame = PictureCamera(env, args.engine).frame(state, args.size, args.size, STREAMS, args.view)
    step, down = args.size + _GAP_PX, args.size + _LABEL_PX
    sheet = Image.new("RGB", (2 * step - _GAP_PX, -(-len(STREAMS) // 2) * down), "white")
    for i, stream in enumerate(STREAMS):
        x, y = i % 2 * step, i // 2 * down
        sheet.paste(Image.fromarray(as_rgb(stream, frame[stream])), (x, y))
        sheet.paste(legend(stream, frame[stream], args.size), (x, y + args.size))
    sheet.save(args.out, quality=85, method=6)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
