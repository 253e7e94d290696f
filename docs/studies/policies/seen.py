"""`python -m docs.studies.policies.seen RUN -o seen.webp`: an episode of a run in, what its policy was given, out.

The images are the observation itself, noise and all, from the first step to the last at even steps.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from PIL import Image, ImageDraw
from rich.console import Console

from interactive_nav.task.rollout import episode_keys, policy_key_of
from train.runs.run import build_env, config_to_play
from train.runs.run_folder import RunFolder
from train.scoring import SEED
from train.scoring.evaluation import load_policy

_GAP_PX, _LABEL_PX, _FONT_PX = 4, 34, 13
WIDTH_PX = 760


def picture(image: np.ndarray) -> np.ndarray:
    """An image of an observation, [H, W, 1 or 3] of any dtype, for the eye: [H, W, 3] u8; normals from -1 to 1."""
    values = image / 255 if image.dtype == np.uint8 else np.asarray(image, np.float32)
    values = (values + 1) / 2 if values.min() < 0 else values
    return np.repeat(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8), 3 // image.shape[-1], -1)


def strip(frames: Sequence[Mapping[str, np.ndarray]], labels: Sequence[str]) -> Image.Image:
    """Frames side by side, each a column: its images below each other, then its label of two lines.

    Args:
        frames: key of an image -> [H, W, C].
        labels: of each.
    """
    side = (WIDTH_PX + _GAP_PX) // len(frames) - _GAP_PX
    height = len(frames[0]) * (side + _GAP_PX) + _LABEL_PX
    out = Image.new("RGB", (len(frames) * (side + _GAP_PX) - _GAP_PX, height), "white")
    draw = ImageDraw.Draw(out)
    for column, (images, label) in enumerate(zip(frames, labels, strict=True)):
        x = column * (side + _GAP_PX)
        for line, name in enumerate(sorted(images)):
            shown = Image.fromarray(picture(images[name])).resize((side, side), Image.Resampling.NEAREST)
            out.paste(shown, (x, line * (side + _GAP_PX)))
        draw.multiline_text((x, height - _LABEL_PX), label, fill="black", font_size=_FONT_PX, spacing=2)
    return out


def main(argv: Sequence[str] | None = None) -> None:
    """Plays the episode and writes its strip."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("run", type=Path, help="run folder")
    words.add_argument("overrides", nargs="*", help="env.key=value, as for train.evaluate")
    words.add_argument("-o", "--output", type=Path, required=True)
    words.add_argument("--episode", type=int, default=0, help="number, as in the rows of train.evaluate")
    words.add_argument("--checkpoint", default="last", help="best, last or env steps")
    words.add_argument("--frames", type=int, default=6)
    words.add_argument("--scenes", nargs="+", help="folders or sets; default: the run's")
    given = words.parse_intermixed_args(argv)
    folder = RunFolder(given.run)
    config = config_to_play(folder, given.overrides, given.scenes, Console())
    env = build_env(config.env)
    policy, _ = load_policy(folder, config, env, given.checkpoint, deterministic=True)
    key = episode_keys(SEED, given.episode + 1)[given.episode]
    act, step, chances = jax.jit(policy), jax.jit(env.step), policy_key_of(key)
    state, seen, left_m = jax.jit(env.reset)(key), [], []
    while True:
        seen.append({k: np.asarray(v) for k, v in state.obs.items() if k.startswith("pixels/")})
        left_m.append(float(state.info["nav"].geodesic_m))
        if bool(state.done):
            break
        state = step(state, act(state.obs, jax.random.fold_in(chances, len(seen) - 1)))
    at = np.linspace(0, len(seen) - 1, min(given.frames, len(seen))).astype(int)
    dt_s = env.config.control_dt_s
    strip([seen[t] for t in at], [f"{t * dt_s:.1f} s\n{left_m[t]:.1f} m to go" for t in at]).save(
        given.output, quality=90
    )
    scores = {name: round(float(state.metrics[name]), 2) for name in ("success", "ins_0.5")}
    print(f"{given.output}: {len(seen) - 1} steps, {scores}")


if __name__ == "__main__":
    main()
