"""`python -m docs.studies.sensors SCENE -o sensors.png`: a scene folder in, its four streams side by side out."""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw

import interactive_nav
from interactive_nav.pictures.camera import ENGINES, STREAMS, VIEWS, Camera
from interactive_nav.sensing.shading import PALETTES

_GAP_PX, _LABEL_PX = 8, 22


def as_rgb(stream: str, image: np.ndarray, depth_range_m: float = 5.0) -> np.ndarray:
    """A stream's picture for the eye, [H, W, 3] u8: near is bright, nothing is white; classes in the palette's colours.

    Args:
        stream: rgb, normals, depth or segmentation.
        image: as `Camera.frame` gives it.
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
    frame = Camera(env, args.engine).frame(state, args.size, args.size, STREAMS, args.view)
    step = args.size + _GAP_PX
    sheet = Image.new("RGB", (len(STREAMS) * step - _GAP_PX, args.size + _LABEL_PX), "white")
    for i, stream in enumerate(STREAMS):
        sheet.paste(Image.fromarray(as_rgb(stream, frame[stream])), (i * step, 0))
        ImageDraw.Draw(sheet).text((i * step + 2, args.size + 4), stream, fill="black", font_size=14)
    sheet.save(args.out, optimize=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
