"""Decompose one mesh: `python -m converters.bodies.coacd_worker IN.npz OUT.npz`."""

import sys

import coacd
import numpy as np

from converters.clock import peak_memory_mib
from converters.records.errors import CANNOT_WRITE


def main(source: str, target: str) -> None:
    """Run coacd once. Its return value is a list of [vertices (n, 3), faces (m, 3)]."""
    with np.load(source, allow_pickle=False) as arrays:
        values = {k: arrays[k] for k in arrays.files}
    mesh = coacd.Mesh(values.pop("vertices"), values.pop("faces"))
    parameters = {k: v.item() for k, v in values.items()}
    coacd.set_log_level("error")
    parts = coacd.run_coacd(mesh, decimate=True, **parameters)
    arrays = {f"v{i}": np.asarray(v, np.float64) for i, (v, _) in enumerate(parts)}
    arrays |= {f"f{i}": np.asarray(f, np.int64) for i, (_, f) in enumerate(parts)}
    if not parts:
        raise ValueError("coacd returned no part")
    try:
        np.savez(target, count=len(parts), peak_mib=peak_memory_mib(), **arrays)  # pyright: ignore[reportArgumentType]
    except OSError as error:
        print(error)
        sys.exit(CANNOT_WRITE)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
