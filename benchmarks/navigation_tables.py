"""`python -m benchmarks.navigation_tables [--scenes N]`: time and memory of the shortest-path tables.

Scenes are synthetic plans of 160 m2: sixteen rooms, doors, forty fixed blocks. What it measures is the host's work
when an environment is built, and the bytes that stay on the device.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from interactive_nav.geodesic import corner_graph, navigation_grid
from interactive_nav.tables import navigation_tables


def plan(seed: int, side_m: float = 13.0, resolution_m: float = 0.05) -> np.ndarray:
    """[260, 260] bool: a square building of 4 x 4 rooms."""
    rng = np.random.default_rng(seed)
    n = int(side_m / resolution_m)
    free = np.ones((n, n), bool)
    free[:4] = free[-4:] = free[:, :4] = free[:, -4:] = False
    for k in (1, 2, 3):
        at = k * n // 4
        free[at - 1 : at + 1] = free[:, at - 1 : at + 1] = False
    for row in range(4):
        for wall in (1, 2, 3):
            door, at = row * n // 4 + n // 8 + rng.integers(-10, 10), wall * n // 4
            free[door - 9 : door + 9, at - 1 : at + 1] = free[at - 1 : at + 1, door - 9 : door + 9] = True
    for _ in range(40):
        (height, width), r, c = rng.integers(2, 16, 2), rng.integers(0, n - 16), rng.integers(0, n - 16)
        free[r : r + height, c : c + width] = False
    return free


def main() -> None:
    """Prints a line a scene and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=10)
    count = parser.parse_args().scenes
    graphs = []
    for seed in range(count):
        began = time.process_time()
        free = navigation_grid(plan(seed), 0.05, 0.18, 0.05)
        graphs.append(corner_graph(free, 0.05, 0.1, (0.0, 0.0)))
        graph = graphs[-1]
        print(
            f"scene {seed}: {time.process_time() - began:.1f} s of CPU, {len(graph.corner_xy_w)} corners, "
            f"{len(graph.node_xy_w)} nodes, at most {graph.seen.shape[1]} corners seen by one",
            flush=True,
        )
    tables = navigation_tables(graphs)
    size = sum(value.nbytes for value in tables.values() if hasattr(value, "nbytes"))
    print(f"{count} scenes: {size / 1e6:.0f} MB on the device")
    old = sum(1024 * len(graph.node_xy_w) * 6 for graph in graphs)
    print(f"distance and next hop from every node to 1,024 goal cells would take {old / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
