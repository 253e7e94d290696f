"""Run `interactive-nav COMMAND ...`: every program of the project under one name, also as `python -m MODULE ...`."""

import runpy
import signal
import sys
from collections.abc import Sequence

from interactive_nav_common.commands import TYPED, listing, version
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError, reports_errors

PROGRAMS = {
    "demo": ("train.demo", "a film of a trained robot that pushes its way through a flat"),
    "train": ("train", "a policy, from a preset or a file"),
    "sweep": ("train.sweep", "trains and evaluates every run of a table"),
    "evaluate": ("train.evaluate", "plays episodes, with scores"),
    "figures": ("train.figures", "curves, tables and pictures of runs and sweeps"),
    "report": ("train.figures.report", "one HTML file of runs, sweeps and rows, to send"),
    "export": ("train.export", "a policy to an ONNX file"),
    "ros": ("interactive_nav.ros", "a policy, and a simulated robot, as nodes of ROS 2"),
    "record": ("train.record", "a film of an episode"),
    "view": ("interactive_nav.view", "a scene and a robot, in a window or the browser"),
    "robots": ("interactive_nav.robots", "those that come with it"),
    "topological": ("topological_nav", "the navigator by images: map, train, evaluate"),
    "bench": ("benchmarks.steps_per_second", "env steps a second"),
    "convert": ("converters", "scans, drawings and other simulators' homes to scenes"),
    "segment": ("converters", "labels an unlabelled scan, so that furniture in it can move"),
    "annotate": ("converters", "says in the browser which model stands where in a scan"),
    "generate": ("converters", "a scan of a furnished home"),
    "generate-scenes": ("converters", "scenes of a recipe file or a tier"),
    "scenes": ("converters", "lists the homes that have names, and makes those that recipes describe"),
    "preview": ("converters", "a picture of a scene"),
    "check": ("converters", "a scene's gates"),
}
"""Command -> module that is run, and what it does."""


@reports_errors("interactive-nav")
def main(argv: Sequence[str] | None = None) -> int:
    """Run a program as `python -m` does; return its exit code, 2 on a user's error, 128 + signal when stopped."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] == ["--version"]:
        print(version())
        return 0
    if not words or words[0] in ("-h", "--help"):
        print(listing("interactive-nav", {name: about for name, (_, about) in PROGRAMS.items()}))
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
