"""Run `python -m train.evaluate`: evaluate run folders; write Parquet rows, recorded paths and tables of scores."""

import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from interactive_nav_common.commands import parse
from interactive_nav_common.errors import reports_errors
from interactive_nav_common.signals import STOPS, interrupts_heard, number_of, raise_stop
from train.scoring.command import Evaluate


@reports_errors("train.evaluate")
def main(argv: Sequence[str] | None = None, build_env: Callable[..., Any] | None = None) -> int:
    """Evaluate; return 0, 2 on a user's error, or 128 + signal when stopped, which keeps the results so far."""
    kept: dict[Path, str] = {}
    try:
        with interrupts_heard(*STOPS, at_once=False):  # progress raises it, between two chunks
            arguments = parse(Evaluate, "python -m train.evaluate", argv)
            from train.scoring.session import run  # imports JAX, which takes seconds: --help does without

            code = run(arguments, build_env, kept)
            raise_stop()
            return code
    except KeyboardInterrupt as stop:
        saved = "; ".join(kept.values()) or "nothing, no policy had played all"
        number = number_of(stop)
        print(f"train.evaluate: stopped by {signal.Signals(number).name}; kept: {saved}", file=sys.stderr)
        return 128 + number


if __name__ == "__main__":
    sys.exit(main())
