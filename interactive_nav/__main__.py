"""Run `interactive-nav COMMAND ...`: every program of the project under one name, also as `python -m MODULE ...`."""

import runpy
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError, reports_errors
from interactive_nav_common.records import read_packaged
from interactive_nav_common.words import TYPED, version

PROGRAMS = read_packaged(Path(__file__).with_name("programs.yaml"), dict[str, tuple[str, str]])
"""Command -> module that is run, and what it does."""


@reports_errors("interactive-nav")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a program as `python -m` does; return its exit code, 2 on a user's error, 128 + signal when stopped."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["--version"]:
        print(version())
        return 0
    if not words or words[0] in ("-h", "--help"):
        print("usage: interactive-nav COMMAND ...   (interactive-nav COMMAND --help says more; --version)\n")
        print("\n".join(f"  {name:<16} {about}" for name, (_, about) in PROGRAMS.items()))
        return 0 if words else 2
    if words[0] not in PROGRAMS:
        raise ConfigError(f"no command {words[0]!r}{nearest(words[0], list(PROGRAMS))}; --help lists them")
    module, _ = PROGRAMS[words[0]]
    TYPED[f"python -m {module}"] = "interactive-nav" if module == "converters" else f"interactive-nav {words[0]}"
    sys.argv = [module, *words[module != "converters" :]]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    return 0


if __name__ == "__main__":
    sys.exit(main())
