"""Reads damaged files in a process of its own: `python -m tests.fuzz GROUP FIRST LAST [TARGET]` prints a line for each.

A line is `TARGET SEED FILE: ` and `read`, `refused`, or what went wrong. 60 s and 6 GiB are bounds of the process.
"""

from __future__ import annotations

import dataclasses
import faulthandler
import json
import os
import resource
import shutil
import socket
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from interactive_nav_common.errors import UserError
from tests.mutations import SECRETS, mutated

MOST_S, MOST_BYTES = 60, 6 << 30
ROOT = Path(__file__).parents[1]


@dataclasses.dataclass(frozen=True)
class Target:
    """Files of one kind, and what reads them."""

    write: Callable[[Path], Any]
    read: Callable[[Path], Any]
    files: tuple[str, ...] = ("**/*",)
    """Patterns of those that are damaged."""


def _layout(name: str, write: Callable[[Path], Any], *files: str, start: str = "") -> Target:
    from converters.read.source import read_source

    def read(root: Path) -> None:
        raw = read_source(root / start, "auto" if start else name)
        assert np.isfinite(raw.scan.vertices).all(), "vertices that are not finite"
        assert not any(name.startswith(("/", "..")) for name in raw.sources), "sources outside"

    return Target(write, read, files or ("**/*",))


def fresh(write: Callable[..., Any], *words: Any) -> Callable[[Path], None]:
    """A writer that makes its folder itself."""

    def made(root: Path) -> None:
        root.rmdir()
        write(root, *words)

    return made


def scans() -> dict[str, Target]:
    """Layouts of a scan with furniture, single meshes, a URDF."""
    from converters.read.files import SourceFolder
    from converters.read.gibson import read_gibson
    from converters.read.urdf import read_urdf
    from tests.converters import tiny_raw
    from tests.converters.read.homes.test_habitat import DRESSER
    from tests.converters.read.released import write_released

    def released(root: Path) -> None:
        root.rmdir()
        write_released(read_gibson(tiny_raw.write_gibson(root.with_name("gibson"))), root)

    def room(ending: str) -> Callable[[Path], None]:
        def write(root: Path) -> None:
            shell = trimesh.creation.box((4.0, 3.0, 2.4))
            shell.invert()
            table = trimesh.creation.box((0.8, 0.6, 0.7)).apply_translation((0.5, 0.3, -0.85))
            (shell.subdivide() + table).export(root / f"room.{ending}")

        return write

    def urdf(root: Path) -> None:
        trimesh.creation.box((0.3, 0.2, 0.1)).export(root / "box.obj")
        mesh = "<collision><geometry><mesh filename='box.obj' scale='1 1 1'/></geometry></collision>"
        (root / "thing.urdf").write_text(DRESSER.replace("revolute", "fixed").replace("</link>", mesh + "</link>", 1))

    def painted(root: Path) -> None:
        shell = trimesh.creation.box((4.0, 3.0, 2.4))
        shell.invert()
        shell = shell.subdivide()
        table = trimesh.creation.box((0.8, 0.6, 0.7)).apply_translation((0.5, 0.3, -0.85))
        image = Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3))
        shell.visual = trimesh.visual.TextureVisuals(shell.vertices[:, :2] / 4, image=image)
        table.visual.vertex_colors = [10, 200, 30, 255]
        trimesh.Scene([shell, table]).export(root / "room.glb")

    def coloured(root: Path) -> None:
        room("obj")(root)
        lines = (root / "room.obj").read_text().splitlines()
        body = [f"{line} 0.1 0.5 0.9" if line.startswith("v ") else line for line in lines]
        (root / "room.obj").write_text("\n".join(["mtllib room.mtl", *body[:-8], "usemtl wood", *body[-8:]]) + "\n")
        (root / "room.mtl").write_text("newmtl wood\nKd 0.5 0.4 0.3\nmap_Kd -s 2 2 1 -o 0.5 0 0 -clamp on wood.png\n")
        Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(root / "wood.png")

    meshes = {f"mesh {e}": _layout("", room(e), start=f"room.{e}") for e in ("ply", "obj", "glb", "stl", "dae", "off")}
    return meshes | {
        "mesh painted": _layout("", painted, start="room.glb"),
        "mesh coloured": _layout("", coloured, start="room.obj"),
        "gibson": _layout("gibson", fresh(tiny_raw.write_gibson)),
        "scan2cad": _layout("scan2cad", fresh(tiny_raw.write_scan2cad)),
        "interactive-gibson": _layout("interactive-gibson", released),
        "urdf": Target(urdf, lambda root: read_urdf(SourceFolder(root), "thing.urdf", "")),
    }


def homes() -> dict[str, Target]:
    """Homes of other simulators."""
    from tests.converters.read.homes import test_habitat, test_mjcf, test_sdf, test_sh3d

    return {
        "sdf": _layout("sdf", fresh(test_sdf.write_world, test_sdf.ROOM + test_sdf.THINGS + test_sdf.MORE)),
        "habitat": _layout("habitat", fresh(test_habitat.write_home, test_habitat.SCENE_OBJECTS)),
        "mjcf": _layout("mjcf", fresh(test_mjcf.write_room), start="home.xml"),
        "sh3d": _layout("sh3d", test_sh3d.write_home, "flat.sh3d", start="flat.sh3d"),
    }


def scenes() -> dict[str, Target]:
    """What the converters write, and lists of it."""
    from converters.recipes import load_recipes
    from converters.single_object import ObjectConfig, convert_object
    from interactive_nav.episodes import load_episode_file
    from interactive_nav.scenes.objects import load_object
    from interactive_nav.scenes.scene import load_scene
    from scenes_mjcf.schema import load_manifest, load_maps
    from scenes_mjcf.sets import read_set, scene_digest
    from tests.toys import write_room

    def part(source: str, key: str) -> Callable[[Path], None]:
        """The first two of a list or mapping of a file of the repository."""

        def write(root: Path) -> None:
            path = ROOT / "scenes_mjcf" / source
            name = path.name.removesuffix(".gz")
            plain = json.loads(_plain(path)) if ".json" in name else _yaml().safe_load(path.read_text())
            plain[key] = plain[key][:2] if isinstance(plain[key], list) else dict(list(plain[key].items())[:2])
            text = json.dumps(plain) if ".json" in name else _yaml().safe_dump(plain)
            (root / name).write_text(text)
            if path.suffix == ".gz":
                import gzip

                (root / path.name).write_bytes(gzip.compress(text.encode()))

        return write

    def small(root: Path) -> None:
        trimesh.creation.box((0.3, 0.2, 0.1)).export(root.parent / "toy_crate.stl")
        root.rmdir()
        config = ObjectConfig(mass_kg=2.0, timeout_s=60)
        convert_object(root.parent / "toy_crate.stl", root, config, root.parent / "cache")

    episodes = "episodes/sparse-turtlebot-test.json.gz"
    names = (Path(episodes).name, Path(episodes).name.removesuffix(".gz"))
    return {
        "scene": Target(
            fresh(write_room), lambda root: (load_manifest(root), load_maps(root), load_scene(root), scene_digest(root))
        ),
        "set": Target(part("cluttered/set.json", "scenes"), lambda root: read_set(root / "set.json")),
        "recipes": Target(
            part("cluttered/recipes.yaml", "scenes"), lambda root: load_recipes(root / "recipes.yaml")
        ),
        "episodes": Target(part(episodes, "episodes"), lambda root: [load_episode_file(root / n) for n in names]),
        "object": Target(small, load_object, ("object.*", "assets/*hull*")),
    }  # fmt: skip


def runs() -> dict[str, Target]:
    """What training writes."""
    from interactive_nav_common.runs.weights import rounded, write_weights
    from tests.train.sweep.test_sweep import write_sweep
    from tests.train.toy_run import toy_config
    from topological_nav.learn.learning import read_description, read_weights, write_network
    from topological_nav.maps.graph import TopologicalMap, load_map, save_map
    from train.config_io import to_yaml
    from train.runs import checkpoint
    from train.runs.run_folder import RunFolder
    from train.sweep import spec
    from train.sweep.folder import SweepFolder

    weights = {
        "params": {"kernel": np.ones((3, 2), np.float32), "bias": np.zeros(2, np.float32)},
        "normalizer_params": {},
    }
    small = {
        "versions.json": {"device": {"kind": "cpu"}, "commit": "a"},
        "summary.json": {"completed": False, "env_steps": 9},
    }

    def run(root: Path, name: str = "") -> None:
        for file, content in small.items():
            (root / name / file).write_text(json.dumps(content))
        lines = [{"env_steps": 256 * k, "wall_s": 1.5, "episodes": 2, "return": 0.5} for k in range(4)]
        (root / name / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        if not name:
            (root / "config.yaml").write_text(to_yaml(toy_config(root.parent)))

    def read_run(root: Path) -> None:
        folder = RunFolder(root)
        folder.read_config()
        folder.origin()
        folder.read_metrics()

    def sweep(root: Path) -> None:
        folder = SweepFolder(spec.load_sweep(str(write_sweep(root))))
        folder.prepare()
        for k, each in enumerate(folder.sweep.runs):
            (folder.runs / each.name).mkdir()
            run(folder.runs, each.name)
            if k % 2:
                folder.give_up(each.name, "train: ended with exit code 1", 3)

    def read_sweep(root: Path) -> None:
        folder = SweepFolder(spec.load_sweep(str(root / "small.yaml")))
        told = [folder.state(each) for each in folder.sweep.runs]
        assert all("\n" not in state.reason for state in told), "a reason of several lines"

    def saved(root: Path) -> None:
        state = {"x": np.zeros(3, np.float32)}
        snapshot = type("Snapshot", (), {"learner": weights, "env_state": state})()
        meta = checkpoint.CheckpointMeta(5, 1.0, 0.5, "ppo", "turtlebot", ("lidar",), 3, 2)
        path = checkpoint.save_snapshot(root, snapshot, meta, 2, 10.0)
        (root / "exported").mkdir()
        flat = {"params/kernel": np.ones((3, 2), np.float32), "params/bias": np.zeros(2, np.float32)}
        write_weights(root / "exported" / checkpoint.POLICY, rounded(flat, 0.5, 1), {})
        shutil.copy(path / checkpoint.META, root / "exported")
        path.rename(root / "newest")

    def read_checkpoint(root: Path) -> None:
        checkpoint.read_meta(root / "newest")
        for name in ("newest", "exported"):
            checkpoint.load_learner(root / name, weights)
        checkpoint.load_env_state(root / "newest", {"x": np.zeros(3, np.float32)})

    def network(root: Path) -> None:
        write_network(root, weights, {"task": "rooms", "export": {}})
        rng = np.random.default_rng(0)
        edges = np.array([[0, 1], [1, 2]], np.int32)
        made = TopologicalMap("toy", "digest", xy_w=rng.random((3, 2)), room=np.zeros(3, np.int32),
                              embeddings=np.ones((3, 4), np.float32), edges=edges, p=np.ones(2), angle_rad=np.zeros(2),
                              about={})  # fmt: skip
        save_map(made, root / "map.npz")

    def read_network(root: Path) -> None:
        read_weights(root, weights, read_description(root, "network", "rooms"))
        load_map(root / "map.npz", "digest")

    return {
        "run": Target(run, read_run),
        "sweep": Target(sweep, read_sweep, ("small.yaml", "*/**/*.json", "*/**/*.jsonl")),
        "checkpoint": Target(saved, read_checkpoint),
        "network": Target(network, read_network),
    }


def given() -> dict[str, Target]:
    """What users write or hand over: settings, sweeps, robots, rows to draw."""
    import warnings

    import yaml

    from interactive_nav.robots import get_robot
    from interactive_nav.robots.reference import _LOADED
    from interactive_nav_common.figures import plt
    from tests.interactive_nav.robots.test_add_a_robot import _cart
    from tests.interactive_nav.robots.urdf import cart
    from tests.train.synthetic import baseline_rows, run_rows
    from tests.train.toy_run import toy_config
    from train import config_io
    from train.figures import tables
    from train.figures.results import Results, chosen_split, figures_of
    from train.scoring.rows import BY_CATEGORY
    from train.sweep import spec

    def rows(root: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts = [
            run_rows("fetch", a, k, s, 0.5, (0.9, 0.8)) for a in ("ppo", "sac") for k in (0.0, 1.0) for s in (0, 1)
        ]
        table = pa.concat_tables([*parts, baseline_rows("fetch")])
        entry = {name: 1 for name in ("objects", "touched", "contact_steps", "displacement_m", "force_sum_n")}
        told = pa.array([[{"category": "chair", **entry}]] * len(table), BY_CATEGORY)
        table = table.append_column("by_category", told).append_column("structure_steps", pa.array([0.0] * len(table)))
        pq.write_table(table, root / "rows.parquet")

    def read_rows(root: Path) -> None:
        found = Results(root)
        if found.swept:
            tables.document(found.rows, chosen_split(found.rows, "auto"))
        for _, draw in figures_of(root):
            draw()
            plt.close("all")

    def robots(root: Path) -> None:
        motor, velocity = '<motor name="old" joint="fl"/>', '<velocity joint="fl" kv="1" ctrlrange="-8 8"/>'
        sidecar = {
            "max_wheel_speed_rad_s": 4,
            "body_width_m": 0.5,
            "camera": {"body": "base_link", "pos_m": [0.1, 0, 1]},
        }
        (root / "porter.urdf").write_text(cart())
        (root / "porter.yaml").write_text(yaml.safe_dump(sidecar | {"torque_limits": {"left_joint": 2}}))
        (root / "rover.xml").write_text(_cart().replace(motor, velocity))

    def read_robots(root: Path) -> None:
        _LOADED.clear()
        for name in ("porter.urdf", "rover.xml"):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                get_robot(str(root / name))

    def settings(root: Path) -> None:
        config = yaml.safe_load(config_io.to_yaml(toy_config(root.parent)))
        (root / "config.yaml").write_text(yaml.safe_dump(config))
        shutil.copy(ROOT / "train" / "configs" / "sweeps" / "kint.yaml", root / "sweep.yaml")

    def read_settings(root: Path) -> None:
        config_io.load_config(str(root / "config.yaml"))
        spec.load_sweep(str(root / "sweep.yaml"))

    return {
        "rows": Target(rows, read_rows),
        "robots": Target(robots, read_robots),
        "settings": Target(settings, read_settings),
    }


GROUPS = {"scans": (scans, 12), "homes": (homes, 4), "scenes": (scenes, 5), "runs": (runs, 4), "given": (given, 3)}
"""Name -> its targets, and how many there are."""


def _plain(path: Path) -> bytes:
    import gzip

    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def _yaml() -> Any:
    import yaml

    return yaml


class Watch:
    """Files that are opened while it looks; mutable."""

    def __init__(self, base: Path, root: Path):
        own = (root, sys.prefix, sys.base_prefix, ROOT, "/proc", "/sys", "/usr", "/lib", "/dev",
               os.environ.get("JAX_COMPILATION_CACHE_DIR", ROOT),
               os.path.join(tempfile.gettempdir(), "sh3d-"))  # fmt: skip  # where drawings are unpacked
        self.allowed = tuple(f"{os.path.realpath(p)}" for p in own)
        self.looks, self.outside = False, set()
        self.secrets = [base / name for name in SECRETS]
        for path in self.secrets:
            path.write_text("v 77.125 77.125 77.125\n" * 3 + "f 1 2 3\n")
        sys.addaudithook(self.hook)

    def hook(self, event: str, words: tuple[Any, ...]) -> None:
        if event == "open" and self.looks and isinstance(words[0], str | bytes):
            path = os.path.realpath(os.fsdecode(words[0]))
            if not path.startswith(self.allowed):
                self.outside.add(path)

    def begin(self) -> None:
        for path in self.secrets:  # older than what was last written: the next to read it moves the time
            os.utime(path, ns=(0, path.stat().st_mtime_ns))
        self.looks = True

    def end(self) -> set[str]:
        self.looks = False
        found = self.outside | {str(path) for path in self.secrets if path.stat().st_atime_ns}
        self.outside = set()
        return found


SPECIAL = 0.06
"""How often a file becomes something else than a file."""


def damage(path: Path, good: bytes, seed: list[int]) -> None:
    """Puts a damaged file in place of a good one, or a FIFO, a device, a folder, a socket, or a link to nowhere."""
    rng = np.random.default_rng([*seed, 1])
    if rng.random() >= SPECIAL:
        path.write_bytes(mutated(path.name, good, np.random.default_rng(seed)))
        return
    path.unlink()
    kind = ("fifo", "zero", "folder", "socket", "circle")[int(rng.integers(5))]
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            here = os.getcwd()
            os.chdir(path.parent)  # an address has 108 bytes
            made.bind(path.name)
            os.chdir(here)
    else:
        path.symlink_to("/dev/zero" if kind == "zero" else path.name)


def mend(path: Path, good: bytes) -> None:
    """Puts the good file back."""
    path.rmdir() if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
    path.write_bytes(good)


def one(target: Target, root: Path, path: Path, good: bytes, seed: list[int], watch: Watch) -> str:
    """Reads with a file damaged and puts it back; says what came of it."""
    damage(path, good, seed)
    faulthandler.dump_traceback_later(MOST_S, exit=True)
    watch.begin()
    try:
        target.read(root)
        told = "read"
    except UserError as error:
        several = "\n" in str(error) or not 20 < len(str(error)) < 2000 or "77.125" in str(error)
        told = f"WRONG: {str(error)[:500]!r}" if several else "refused"
    except BaseException as error:  # noqa: BLE001  (whatever it is, it is no refusal)
        at, trace = "", error.__traceback__
        while trace:
            at, trace = f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno} {at}", trace.tb_next
        told = f"TRACEBACK: {type(error).__name__}: {str(error)[:300]!r} at {at[:400]}"
    finally:
        faulthandler.cancel_dump_traceback_later()
        outside = watch.end()
        mend(path, good)
    return f"OUTSIDE: {sorted(outside)}" if outside else told


def main(group: str, first: int, last: int, only: str = "") -> int:
    """Reads each target of a group with the changes of seeds `first` up to `last`."""
    out, targets = os.fdopen(os.dup(1), "w"), GROUPS[group][0]()
    os.dup2(2, 1)  # where MuJoCo prints its warnings
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    with tempfile.TemporaryDirectory() as folder:
        base = Path(os.path.realpath(folder)) / "beside"
        base.mkdir()
        watch = Watch(base, base / "tree")
        for name, target in targets.items():
            if only not in ("", name):
                continue
            root = base / "tree" / name.replace(" ", "_") / "in"
            root.mkdir(parents=True)
            target.write(root)
            target.read(root)
            paths = sorted({p for pattern in target.files for p in root.glob(pattern) if p.is_file()})
            for k in range(first, last):
                seed = [zlib.crc32(name.encode()), k]
                path = paths[k % len(paths)]
                print(f"{name} {k} {path.relative_to(root)}: ", end="", flush=True, file=out)
                print(one(target, root, path, path.read_bytes(), seed, watch), flush=True, file=out)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:]))
