"""Cost of a conversion: a generated building in, two JSON rows (cold cache, warm cache) out.

    python -m docs.studies.convert --faces 50000

Generates a sparsely furnished home of about that many scan faces and converts it twice with one new cache folder, each
time in a process of its own. A row holds wall seconds in all and of each stage, the peak resident memory, and the
machine. Memory is the larger of the converter's own peak and its largest child's (`resource.getrusage`), and beside it
the sum of the converter and `--jobs` such children, which bounds what all hold together. Rows are appended to
`benchmarks/results/convert.jsonl.gz`; on a machine that others use, times are upper bounds: the load is recorded beside
them, and `cpu_s`, the processor seconds of the converter and its children, which depends on it little.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.steps_per_second import append_row, origin
from converters.generate import generate_building
from converters.generate.homes.config import HomeConfig, home_config
from docs.studies import command_line

PACKAGES = ("mujoco", "coacd", "trimesh", "numpy", "scipy", "xatlas")
LIMITS = {"cold_s": 600.0, "warm_s": 30.0, "memory_mib": 6 * 1024.0}
"""What the converter is meant to keep on two cores."""

MEASURE = """
import json, os, sys, time
start = time.perf_counter()
from pathlib import Path
from converters.clock import peak_memory_mib
from converters.pipeline import ConvertConfig, convert
done = convert(Path(sys.argv[1]), Path(sys.argv[2]), ConvertConfig(jobs=int(sys.argv[4])), cache=Path(sys.argv[3]))
print(json.dumps({
    "wall_s": round(time.perf_counter() - start, 1),
    "cpu_s": round(sum(os.times()[:4]), 1),
    "stage_s": {k: round(v, 2) for k, v in done.stage_s.items()},
    "peak_mib": round(peak_memory_mib()),
    "peak_child_mib": round(done.worker_mib),
    "objects": len(done.manifest.objects),
    "hulls": sum(o.n_hulls for o in done.manifest.objects),
    "floor_area_m2": done.manifest.floor_area_m2,
    "failed_gates": [g.name for g in done.gates if not g.passed],
}))
"""


def building_config(faces: int) -> HomeConfig:
    """A home of the sparse tier whose scan has about so many faces."""
    area = faces / home_config("sparse", {}).faces_per_m2
    rooms = max(4, round(area / 16))
    return home_config("sparse", {"floor_area_m2": (area, 1.07 * area), "n_rooms": (rooms, rooms + 1)})


def measure(raw: Path, out: Path, cache: Path, jobs: int) -> dict[str, Any]:
    """Converts in a fresh process, so that its memory and imports are its own."""
    command = [sys.executable, "-c", MEASURE, str(raw), str(out), str(cache), str(jobs)]
    return json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])


def count_faces(raw: Path) -> int:
    """Triangles of the raw scan."""
    with (raw / "mesh_z_up.obj").open(encoding="ascii") as lines:
        return sum(line.startswith("f ") for line in lines)


def main() -> None:
    """Measures and appends two rows."""
    parser = command_line(__doc__, "convert")
    parser.add_argument("--faces", type=int, default=50_000, help="of the raw scan, about")
    parser.add_argument("--seed", type=int, default=0, help="of the building")
    parser.add_argument(
        "--raw", type=Path, default=None, help="convert this raw Gibson folder instead of generating one"
    )
    parser.add_argument("--jobs", type=int, default=2, help="decompositions side by side")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="convert-") as folder:
        base = Path(folder)
        clock = time.perf_counter()
        if args.raw is None:
            generate_building(base / "raw", args.seed, config=building_config(args.faces))
        raw = args.raw or base / "raw"
        generate_s = round(time.perf_counter() - clock, 1)
        for kind in ("cold", "warm"):
            load = os.getloadavg()[0]
            row: dict[str, Any] = {"cache": kind, "faces": count_faces(raw), "seed": args.seed}
            row["building"] = "given folder" if args.raw else f"generated: --faces {args.faces}"
            row |= measure(raw, base / kind, base / "cache", args.jobs)
            row |= {
                "memory_bound_mib": row["peak_mib"] + args.jobs * row["peak_child_mib"],
                "generate_s": generate_s,
                "jobs": args.jobs,
                "load_before": round(load, 1),
                "load_after": round(os.getloadavg()[0], 1),
                **origin(args.commit, PACKAGES),
                "device": f"cpu, {os.cpu_count()} cores",
            }
            append_row(args.out, row)
            kept = row["wall_s"] <= LIMITS[f"{kind}_s"] and row["memory_bound_mib"] <= LIMITS["memory_mib"]
            print(f"{kind}: {'within' if kept else 'BEYOND'} {LIMITS[f'{kind}_s']:.0f} s and 6 GiB", file=sys.stderr)


if __name__ == "__main__":
    main()
