"""Run `interactive-nav COMMAND ...`: every program of the project under one name, also as `python -m MODULE ...`."""

import runpy
import signal
import sys
from collections.abc import Sequence

from interactive_nav_common.commands import TYPED, listing, version
from interactive_nav_common.config import nearest
from interactive_nav_common.errors import ConfigError, reports_errors

PROGRAMS = {
    "demo": ("train.demo", "Film a trained robot that pushes its way through a flat."),
    "train": ("train", "Train a policy from a preset or a YAML file."),
    "sweep": ("train.sweep", "Train and evaluate every run of a table of settings."),
    "evaluate": ("train.evaluate", "Play fixed episodes and score them."),
    "figures": ("train.figures", "Draw curves and pictures of runs and sweeps, and print tables."),
    "report": ("train.figures.report", "Write one HTML file about runs, sweeps and rows."),
    "export": ("train.export", "Export a policy as an ONNX file."),
    "ros": ("interactive_nav.ros", "Run a policy or a simulated robot as a ROS 2 node."),
    "record": ("train.record", "Make a video of an episode."),
    "view": ("interactive_nav.view", "Look at a scene and a robot, in a window or in the browser."),
    "robots": ("interactive_nav.robots", "Print a table of robots."),
    "topological": ("topological_nav", "Map homes and navigate by images: map, train, evaluate and more."),
    "bench": ("benchmarks.steps_per_second", "Measure environment steps per second."),
    "convert": ("converters", "Convert scans, drawings and homes of other simulators into scenes."),
    "segment": ("converters", "Label an unlabelled scan, so that its furniture can become movable."),
    "annotate": ("converters", "Place CAD models in a scan by hand, in the browser."),
    "generate": ("converters", "Generate a scan of a furnished home."),
    "generate-scenes": ("converters", "Generate the scenes of a recipe file or of a tier."),
    "scenes": ("converters", "List the named homes, and generate those that have recipes."),
    "preview": ("converters", "Draw a picture of a scene."),
    "check": ("converters", "Run the acceptance gates on a scene."),
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
