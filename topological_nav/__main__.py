"""`python -m topological_nav data|train|map|navigate|evaluate|adapt|export`: words in, files and pictures out.

Exit codes: 0 done, 2 on a user's error (one line on stderr), 128 + signal when asked to stop: the same command goes on.
"""

import importlib
import re
import signal
import sys
from collections.abc import Sequence

from interactive_nav_common.errors import reports_errors
from topological_nav.commands.parser import parser
from topological_nav.errors import Stopped

RUNS = {
    **{"data": "learning.data", "train": "learning.train", "map": "maps.make_map", "navigate": "episodes.navigate"},
    **{"evaluate": "episodes.evaluate", "adapt": "adapt.run", "export": "maps.export_runs"},
}
"""Command -> what runs it, in a module that is imported once the command is known: it is heavy."""


@reports_errors("topological_nav")
def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command."""
    words = list(sys.argv[1:] if argv is None else argv)
    settings = [word for word in words if re.match(r"\w+=", word)]
    arguments = parser().parse_args([word for word in words if word not in settings])
    arguments.settings = settings
    try:
        module, _, name = RUNS[arguments.command].partition(".")
        getattr(importlib.import_module(f"topological_nav.commands.{module}"), name)(arguments)
    except (Stopped, KeyboardInterrupt) as stopped:  # the latter: before the work began, or at a second Ctrl-C
        print("topological_nav: stopped; the same command goes on", file=sys.stderr)
        return 128 + (stopped.args[0] if isinstance(stopped, Stopped) else signal.SIGINT)
    return 0


if __name__ == "__main__":
    sys.exit(main())
