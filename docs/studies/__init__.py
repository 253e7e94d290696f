"""One-off studies behind numbers of the documentation: programs to run in a checkout, not part of the package."""

import argparse
import gzip
import json
from pathlib import Path

RESULTS = Path("benchmarks/results")


def read_rows(path: Path) -> list[dict]:
    """Return the rows of a packed file of JSON lines."""
    return [json.loads(line) for line in gzip.decompress(path.read_bytes()).splitlines()]


def command_line(description: str | None, rows: str = "", settings: bool = False) -> argparse.ArgumentParser:
    """Return a parser with the options that studies share; `rows` names a file in `RESULTS` to write.

    With `settings`, `--set key=value` changes the environment.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)

    def setting(word: str) -> tuple[str, object]:
        name, _, value = word.partition("=")
        return name, json.loads(value)

    if settings:
        parser.add_argument("--scenes", nargs="+", default=["scenes_mjcf/apartment_0"])
        parser.add_argument("--robot", default="turtlebot")
        parser.add_argument("--set", dest="settings", type=setting, nargs="*", default=[], metavar="key=value")
    if rows:
        parser.add_argument("--commit", help="recorded in the row; default: git's HEAD")
        parser.add_argument("--out", type=Path, default=RESULTS / f"{rows}.jsonl.gz", help="where rows are appended")
    return parser
