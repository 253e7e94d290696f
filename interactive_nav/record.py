"""Run `python -m interactive_nav.record REPLAY -o out.mp4`: draw a replay as a video or as a Rerun recording.

The picture shows the robot from behind with its goal and path, its camera's images, and a panel with reward, force and
touches; `--views` shows the home instead. `python -m train.record RUN` plays and draws a run's episode.
"""

import contextlib
import itertools
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import imageio_ffmpeg
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from interactive_nav.pictures import camera as drawing
from interactive_nav.pictures.replay import Replay, ReplayError, load_replay, replay_path
from interactive_nav.pictures.rerun_file import need_rerun, write_recording
from interactive_nav.pictures.scene_model import ROBOT, SCENE, clear_way
from interactive_nav.robots import get_robot
from interactive_nav.scenes.scene import Scene, load_scene
from interactive_nav_common.commands import Command, option, parse, word
from interactive_nav_common.config import AtLeastOne, Natural, refuse_unused
from interactive_nav_common.errors import ConfigError, reports_errors, typed
from interactive_nav_common.files import whole_file
from interactive_nav_common.jobs.progress import SafeConsole, progress_bar
from interactive_nav_common.rotations import yaw_from_quat
from scenes_mjcf.look import CameraPose, Lens, look_along, straight_down

FORMATS = (".mp4", ".gif", ".webp")
CAMERA_PIXELS = 68
"""Depth and mask are rendered at the resolution of the paper's policies (section V)."""
_CAMERA_LAG_S = 1.0
"""The camera behind the robot turns smoothly: a Gaussian of this width over its heading."""
_BESIDE_M, _BESIDE_RAD = (2.0, 2.0), 1.8
"""How far from the robot and how high the camera of the view `beside` is, and how far from straight behind."""
_HOLD_S = 1.5
"""The last picture stays so long."""


class Compositor:
    """Frames of one replay."""

    def __init__(self, replay: Replay, scene: Scene, height: int = 360, views: Sequence[str] = ()):
        """Compile the scene that the replay was recorded in; raise `ReplayError` if it has changed since.

        `height` of the view from behind is a multiple of 12, for whole, even pixels. `views` replace it and
        the robot's camera.
        """
        check_height(height)
        if scene.digest != replay.scene_digest:
            raise ReplayError(
                f"{scene.path}: scene.xml or maps.npz has changed since the replay was recorded; "
                "record the episode again"
            )
        self.replay, self.height, self.views = replay, height, tuple(views)
        self._columns, self._strip = height * 4 // 3, height // 6
        self.size = len(views) * self._columns or self._columns + height // 3, height + self._strip
        """Columns and rows of a frame."""
        self._view = drawing.SceneView(get_robot(replay.robot), scene, replay.small, replay.segmentation_classes)
        self._middle_m = 0.6 * self._view.robot.height_m
        yaw = np.unwrap(yaw_from_quat(replay.body_quat_w[:, 0]))
        self._yaw = gaussian_filter1d(yaw, _CAMERA_LAG_S / replay.control_dt_s, mode="nearest")
        self._target = gaussian_filter1d(replay.body_pos_w[:, 0], 0.2 / replay.control_dt_s, axis=0, mode="nearest")
        self._cameras = {view: self._positions(view) for view in self.views if view != "above"}
        # Pillow's font has spaces of 0.2 em, which round to nothing between some letters of small sizes.
        self._font = ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts/ttf/DejaVuSans.ttf"), height / 28)

    def frame(self, step: int) -> np.ndarray:
        """Draw [rows, columns, 3] u8: the state after `step` control steps."""
        view, replay, height = self._placed(step), self.replay, self.height
        paint = drawing.FloorPaint(replay.goal_xy_w, replay.success_distance_m, _dense(replay.robot_xy_w[: step + 1]))
        if self.views:
            panes = [view.textured(*self._camera(v, step), (*SCENE, ROBOT), paint) for v in self.views]
            return np.concatenate([np.concatenate(panes, 1), self._caption(step)], 0)
        camera = drawing.chase_camera(self._target[step], float(self._yaw[step]), height, self._columns)
        behind = view.render(*camera, drawing.OUTSIDE, paint)["rgb"]
        side = height // 3
        cameras = [drawing.robot_camera(view, n, n, replay.image_fov_deg) for n in (side, CAMERA_PIXELS)]
        colour, image = view.render(*cameras[0], SCENE)["rgb"], view.render(*cameras[1], SCENE)
        depth_m, mask = image["depth"], image["segmentation"]
        small = [drawing.depth_picture(depth_m), drawing.mask_picture(mask, depth_m, replay.segmentation_classes)]
        large = (Image.fromarray(x).resize((side, side), Image.Resampling.NEAREST) for x in small)
        picture = np.concatenate([behind, np.concatenate([colour, *map(np.asarray, large)], 0)], 1)
        return np.concatenate([picture, self._caption(step)], 0)

    def _placed(self, step: int) -> drawing.SceneView:
        self._view.place(self.replay.bodies, self.replay.body_pos_w[step], self.replay.body_quat_w[step])
        return self._view

    def _positions(self, view: str) -> np.ndarray:
        """Return [T + 1, 3] m: behind or beside the robot and in front of walls and furniture, without jerks."""
        back_m, up_m = drawing.BEHIND_M.get(view, _BESIDE_M)
        steps, up_m, best = _CAMERA_LAG_S / self.replay.control_dt_s, up_m - self._middle_m, (-1.0, np.zeros(3))
        # Behind where it goes, not where it looks: a robot turns on the spot. It backs off from what it pulls, however.
        moved = np.gradient(self._target[:, :2], axis=0)
        forward = np.cos(self._yaw) * moved[:, 0] + np.sin(self._yaw) * moved[:, 1] >= 0
        ahead = gaussian_filter1d(np.where(forward[:, None], moved, -moved), 2 * steps, axis=0, mode="nearest")
        yaw = gaussian_filter1d(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), steps, mode="nearest")
        target = self._target * [1, 1, 0] + [0, 0, self._middle_m]
        for turn in (-_BESIDE_RAD, _BESIDE_RAD) if view == "beside" else (0.0,):  # the side with more room
            back = np.stack([-back_m * np.cos(yaw + turn), -back_m * np.sin(yaw + turn), 0 * yaw + up_m], -1)
            share = [clear_way(self._placed(i), *way) for i, way in enumerate(zip(target, back, strict=True))]
            share = gaussian_filter1d(minimum_filter1d(share, max(1, round(2 * steps))), steps / 2, mode="nearest")
            best = max(best, (share.sum(), target + share[:, None] * back), key=lambda side: side[0])
        return best[1]

    def _camera(self, view: str, step: int) -> tuple[CameraPose, Lens]:
        if view != "above":
            eye = self._cameras[view][step]
            ahead = self._target[step] * [1, 1, 0] + [0, 0, self._middle_m] - eye
            return look_along(eye, ahead), Lens(self._columns, self.height, 60.0)
        xy_w = np.vstack([self.replay.robot_xy_w, self.replay.goal_xy_w])
        return straight_down(xy_w.min(0) - 1.2, xy_w.max(0) + 1.2, 4 / 3, 30.0), Lens(self._columns, self.height, 30.0)

    def _caption(self, step: int) -> np.ndarray:
        replay, (columns, _) = self.replay, self.size
        strip = Image.new("RGB", (columns, self._strip), (24, 28, 36))
        draw = ImageDraw.Draw(strip)
        scores, at = replay.metrics, max(step - 1, 0)
        touched = "an object" if replay.touches_movable[at] else "a wall" if replay.touches_structure[at] else "nothing"
        about = f"reward {replay.reward[:step].sum():6.2f}   force {replay.force_n[at] if step else 0.0:5.1f} N   "
        about += f"touches {touched}" * bool(step)
        if step == replay.num_steps:
            about = "succeeded" if scores["success"] else "failed"
            for name, key in (("P_eff", "path_efficiency"), ("E_eff", "effort_efficiency"), ("INS_0.5", "ins_0.5")):
                about += f"   {name} {scores[key]:.2f}"
        where = f"{replay.policy}  episode {replay.episode}  {Path(replay.scene).name}  {replay.label}"
        lines = where, f"{step * replay.control_dt_s:5.1f} s   {about}"
        for i, line in enumerate(lines):
            draw.text((self._strip // 5, self._strip * (1 + 4 * i) // 9), line, font=self._font, fill=(235, 238, 242))
        return np.asarray(strip)


def check_height(height: int) -> None:
    """Raise `ConfigError` unless every part of a frame of so many rows has whole, even pixels."""
    if height < 120 or height % 12:
        raise ConfigError(f"height is {height}, expected a multiple of 12 from 120 on")


def check_format(path: Path) -> None:
    """Raise `ReplayError` unless a video can be written to a file of that ending."""
    if path.suffix not in FORMATS:
        raise ReplayError(f"{path}: ends in '{path.suffix}', expected one of {', '.join(FORMATS)}")


def _dense(path: np.ndarray, step_m: float = 0.03) -> np.ndarray:
    """Return an [n, 2] path with points at most `step_m` apart."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, length[-1] + step_m, step_m)
    return np.stack([np.interp(at, length, path[:, i]) for i in range(2)], -1)


def write_video(
    compositor: Compositor, path: Path, every: int = 1, on_progress: Callable[[int], None] = lambda frames: None
) -> int:
    """Write a video (.mp4, .gif, .webp) in real time, atomically; return the number of different frames.

    Frames are `every` control steps apart; `on_progress` receives the number of frames written.
    """
    check_format(path)
    steps = [*range(0, compositor.replay.num_steps, every), compositor.replay.num_steps]
    rate = 1.0 / (compositor.replay.control_dt_s * every)
    write = write_mp4 if path.suffix == ".mp4" else _write_frames

    def frames() -> Iterator[np.ndarray]:
        for i, step in enumerate(steps):
            yield compositor.frame(step)
            on_progress(i + 1)

    with whole_file(path) as partial:
        write(frames(), partial, rate, _HOLD_S)
    return len(steps)


def write_mp4(frames: Iterable[np.ndarray], path: Path, rate: float, hold_s: float = 0.0) -> int:
    """Write H.264 of even-sided [rows, columns, 3] u8 frames at `rate` Hz; return the number of different frames.

    The last frame stays for `hold_s`.
    """
    settings: dict[str, Any] = {"fps": rate, "quality": 7, "codec": "libx264", "macro_block_size": 2}
    settings["output_params"] = ["-movflags", "+faststart", "-preset", "medium"]
    frames, count = iter(frames), 0
    frame = first = next(frames)
    with contextlib.closing(imageio_ffmpeg.write_frames(str(path), first.shape[1::-1], **settings)) as writer:
        with warnings.catch_warnings():
            # imageio-ffmpeg forks; its child becomes ffmpeg at once and never enters JAX.
            warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
            writer.send(None)
        for frame in itertools.chain([first], frames):
            writer.send(np.ascontiguousarray(frame))
            count += 1
        for _ in range(round(hold_s * rate)):
            writer.send(np.ascontiguousarray(frame))
    return count


def _write_frames(frames: Iterator[np.ndarray], path: Path, rate: float, hold_s: float) -> None:
    pictures = [Image.fromarray(f) for f in frames]
    if path.suffix == ".gif":
        pictures = [picture.quantize(128, dither=Image.Dither.NONE) for picture in pictures]
    shown_ms = [round(1000 / rate)] * (len(pictures) - 1) + [round(1000 * hold_s)]
    words: dict[str, Any] = {"quality": 40, "method": 4, "minimize_size": True} if path.suffix == ".webp" else {}
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=shown_ms, loop=0, **words)


class Picture(Command):
    """Make a video of an episode."""

    episode: Natural = 0
    """Number of the fixed episode, starting at 0."""
    policy: str = "learned"
    """Policy that drives, named as in `python -m train.evaluate`."""
    out: Annotated[Path, option("-o", metavar="PATH")] = Path("episode.mp4")
    """Video file to write (.mp4, .gif or .webp)."""
    rerun: Annotated[Path | None, option(metavar="FILE.rrd")] = None
    """Write a Rerun recording to this file instead of a video."""
    height: int = 360
    """Height of the view from behind in pixels, a multiple of 12 from 120 on."""
    views: Annotated[tuple[Literal["eye", "follow", "beside", "above"], ...], option()] = ()
    """Textured views to show side by side, instead of the default layout."""
    every: AtLeastOne = 1
    """Number of control steps between two frames."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_format(self.out)
        check_height(self.height)
        if self.rerun:
            need_rerun()
            refuse_unused(self, "--views", "with --rerun, which makes no video")

    def source(self, console: Console) -> Path:
        """Return the replay to draw."""
        raise NotImplementedError

    def film(self, program: str) -> int:
        """Draw the replay; return the program's exit code: 0, or 130 when interrupted."""
        console = SafeConsole()
        try:
            source = self.source(console)
            replay = load_replay(source)
            compositor = Compositor(replay, load_scene(replay.scene), self.height, self.views)
            with progress_bar(console, "frames", -(-replay.num_steps // self.every) + 1, transient=True) as update:
                how: Any = self.every, lambda n: update(completed=n)
                if self.rerun:
                    frames = write_recording(replay, compositor._view, self.rerun, self.height // 3, *how)
                else:
                    frames = write_video(compositor, self.out, *how)
        except KeyboardInterrupt:
            print(f"{program}: stopped; no video was written", file=sys.stderr)
            return 130
        about = f"{frames} frames of {replay.policy}, episode {replay.episode}; replay: {source}"
        console.print(f"{self.rerun or self.out}: {about}")
        return 0


class Record(Picture):
    """Make a video of an episode from its replay."""

    replay: Annotated[Path, *word("REPLAY")]
    """Replay file (.npz), or run folder that contains the replay of the episode."""

    def source(self, console: Console) -> Path:
        if self.replay.suffix == ".npz":
            return self.replay
        path = replay_path(self.replay, self.policy, self.episode)
        if not path.is_file():
            words = typed(self.replay, "--episode", self.episode, "--policy", self.policy, "-o", self.out)
            raise ReplayError(f"{path}: no such replay; play the episode and draw it: python -m train.record {words}")
        return path


@reports_errors("interactive_nav.record")
def main(argv: Sequence[str] | None = None) -> int:
    """Record a video; return 0 when done, 2 on a user's error, 130 when interrupted."""
    return parse(Record, "python -m interactive_nav.record", argv).film("interactive_nav.record")


if __name__ == "__main__":
    sys.exit(main())
