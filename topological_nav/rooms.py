"""`python -m topological_nav.rooms SCENE... -o rooms.png`: scenes in, a picture and a table of their rooms out."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from interactive_nav_common.errors import reports_errors
from topological_nav.scenes.rooms import compare


@reports_errors("topological_nav.rooms")
def main(argv: Sequence[str] | None = None) -> int:
    """Draws and prints; 0 when done, 2 on a user's error."""
    made = argparse.ArgumentParser(prog="python -m topological_nav.rooms", description=__doc__)
    made.add_argument("scenes", nargs="+", metavar="SCENE", help="scene folders")
    made.add_argument("-o", "--out", default="rooms.png", metavar="PATH", help="picture (default rooms.png)")
    made.add_argument("--seed", type=int, default=0)
    made.add_argument("--clearance", type=float, default=0.2, metavar="M", help="of positions (default 0.2)")
    arguments = made.parse_args(argv)
    rows = compare([Path(s) for s in arguments.scenes], arguments.seed, arguments.clearance)
    from topological_nav.figures.maps import rooms_figure, save

    save(rooms_figure(rows), Path(arguments.out))
    for row in rows:
        rand = "" if row["agreement"] is None else f"  adjusted Rand index {row['agreement']:.3f}"
        print(f"{row['scene']:<14}{row['method']:<10}{row['count']:>3} rooms ({row['chosen_by']}){rand}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
