"""Parse, run and print the commands of `python -m converters`.

Exit codes: 0 done, 1 a gate failed (`convert` has written the scene anyway), 2 unusable input (one line on stderr),
130 or 143 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import glob
import math
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from converters.generating import GENERATING
from converters.records.errors import StageFailed
from converters.segmenting import SEGMENTING, label_unlabelled, next_step, propose_unproposed
from interactive_nav_common.config import read_words, refuse_unused
from interactive_nav_common.errors import UserError, printable, reports_errors
from interactive_nav_common.jobs.progress import SafeConsole, stage_progress, warn_once
from interactive_nav_common.signals import STOPS, interrupts_heard, number_of
from interactive_nav_common.words import Command, Commands, Parser, add_words, read_commands
from scenes_mjcf.schema import CATEGORIES
from scenes_mjcf.sets import installed

FORMATS = (
    *("gibson", "interactive-gibson", "scan2cad", "sdf", "habitat", "mjcf", "sh3d"),
    *("scannet", "scannetpp", "arkitscenes", "3rscan", "multiscan", "matterport3d"),
)
"""`READERS` of `converters.read.source`, which need not be imported to say so."""

if TYPE_CHECKING:
    from converters.pipeline import ConvertConfig
    from converters.propose.report import Proposed
    from converters.records.limits import Gate


def bounds(gate: Gate) -> str:
    """Return a gate's limits in words."""
    pairs = ((">=", gate.limit.least), ("<=", gate.limit.most))
    return " ".join(f"{word} {value:g}" for word, value in pairs if value is not None)


def gate_table(gates: tuple[Gate, ...]) -> Table:
    """Return a table of one row a gate."""
    table = Table("gate", "value", "limit", "", title="Gates")
    for gate in gates:
        verdict = Text("PASS", "green") if gate.passed else Text("FAIL", "red")
        table.add_row(gate.name, f"{gate.value:.5g} {gate.limit.unit}", bounds(gate), verdict)
    return table


def alignment_table(rows: tuple[dict[str, Any], ...]) -> Table:
    """Return a table of alignments; `settled` is how far the simulation moved the object from its annotation."""
    heads = ("object", "pairs", "rms cm", "shift cm", "yaw °", "scale x y z", "tilt °", "settled cm")
    table = Table(*heads, title="Pose re-solved from keypoints, against the annotated pose")
    for row in rows:
        if row["solved"]:
            solved = (
                f"{100 * row['rms_m']:.1f}",
                f"{100 * row['translation_difference_m']:.1f}",
                f"{row['yaw_difference_deg']:.1f}",
                " ".join(f"{v:.2f}" for v in row["scale_ratio"]),
            )
        else:
            solved = ("-", "-", "-", row["reason"])
        moved = f"{row['tilt_removed_deg']:.1f}", f"{100 * row['settle_shift_m']:.1f}"
        table.add_row(row["name"], str(row["n_keypoints"]), *solved, *moved)
    return table


def proposal_tables(proposed: Proposed) -> Iterator[Table]:
    """Yield a table of the proposals; and with a library and annotations, how well."""
    table = Table("class", "confidence", "x y z, m", "size, m", "model", "sure", title="Proposals")
    for k, proposal in enumerate(proposed.proposals):
        model = proposed.retrieved.get(k)
        table.add_row(
            proposal.category,
            f"{proposal.confidence:.2f}",
            " ".join(f"{v:.2f}" for v in proposal.centre),
            " ".join(f"{v:.2f}" for v in proposal.extent_m),
            model.cad.cad_id[:8] if model else "-",
            f"{model.confidence:.2f}" if model else "-",
        )
    yield table
    if not proposed.comparisons:
        return
    heads = ("class", "annotated", "chosen", "rank", "cm", "yaw °", "scale x y z", "IoU", "sure")
    caption = "cm, yaw and scale: the annotated model's best fit against its annotated pose"
    table = Table(*heads, title="Retrieved models against the annotation", caption=caption)
    for row in proposed.comparisons:
        table.add_row(
            row.category,
            row.true_cad[:6],
            row.chosen_cad[:6],
            f"{row.rank}/{row.n_tried}",
            f"{100 * row.difference.translation_m:.1f}",
            f"{math.degrees(row.difference.yaw_rad):.1f}",
            " ".join(f"{v:.2f}" for v in row.difference.scale_ratio),
            f"{row.iou:.2f}",
            f"{row.confidence:.2f}",
        )
    yield table


def _words_of(config: type[Any], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a dataclass of choices that the command line has."""
    return {f.name: getattr(arguments, f.name) for f in dataclasses.fields(config) if f.name in arguments}


def _convert(arguments: argparse.Namespace, console: Console) -> int:
    from converters.pipeline import ConvertConfig, convert_building
    from converters.recipes import check_conversion

    check_conversion(settings := read_words(arguments.settings, "object_faces=3000"), "settings")
    words = _words_of(ConvertConfig, arguments)
    words["auto_align"] |= arguments.segment or bool(arguments.library and not arguments.annotations)
    config = ConvertConfig(**words | settings)
    if arguments.into:
        refuse_unused(arguments, "--annotations", "with --into: a file is of one scan")
        return _convert_many(arguments, config, console)
    if arguments.segment:
        label_unlabelled(arguments, console)
        arguments.annotations = arguments.annotations or propose_unproposed(arguments, console)
        config = dataclasses.replace(config, auto_align=arguments.annotations is None)
    warn = warn_once(console)
    with stage_progress(console) as report:
        results = convert_building(
            arguments.source, arguments.out, config, report, warn=warn, annotations=arguments.annotations
        )
    for result in results:
        if any(row.get("n_keypoints") for row in result.manifest.alignment):
            console.print(alignment_table(result.manifest.alignment))
        console.print(gate_table(result.gates))
        for warning in result.manifest.warnings:
            warn(warning)
    times = ", ".join(f"{k} {v:.1f}" for k, v in results[0].stage_s.items())
    console.print(f"Seconds: {times}", soft_wrap=True)
    for result in results:
        for row in result.manifest.alignment:
            if "note" in row:
                console.print(f"{row['name']}: {row['note']}", soft_wrap=True)
        failed = [g.name for g in result.gates if not g.passed]
        console.print(
            f"{result.folder}: {len(result.manifest.objects)} movable objects, {result.n_walls} wall boxes, "
            f"{result.manifest.floor_area_m2:.1f} m² traversable; "
            + (f"gates that fail: {', '.join(failed)}" if failed else "every gate passes"),
            soft_wrap=True,
        )
    layout, moves = results[0].manifest.source["format"], any(result.manifest.objects for result in results)
    if not moves and (word := next_step(arguments, layout)):
        console.print(word, soft_wrap=True, highlight=False)
    return 0 if all(g.passed for result in results for g in result.gates) else 1


def _convert_many(arguments: argparse.Namespace, config: ConvertConfig, console: Console) -> int:
    from converters.many import convert_many
    from converters.sets import make_launcher

    launcher, side_by_side = make_launcher(
        arguments.launcher, arguments.ray_address, min(arguments.jobs, len(arguments.places)), len(arguments.places)
    )
    with stage_progress(console) as report:
        failed = convert_many(
            [Path(place) for place in arguments.places], arguments.into, config, launcher, side_by_side, report,
            lambda line: console.print(line, soft_wrap=True, highlight=False),
        )  # fmt: skip
    if failed:
        console.print(f"not converted, or with gates that fail: {', '.join(failed)}", soft_wrap=True, highlight=False)
    return 1 if failed else 0


def _object(arguments: argparse.Namespace, console: Console) -> None:
    from converters.single_object import ObjectConfig, convert_object

    config = ObjectConfig(**_words_of(ObjectConfig, arguments) | {"source": arguments.within})
    warn = warn_once(console)
    about = convert_object(arguments.source, arguments.out, config, warn=warn)
    for warning in about["warnings"]:
        warn(warning)
    size = " x ".join(f"{100 * v:.1f}" for v in about["size_m"])
    console.print(
        f"{arguments.out}: {about['category']}, {about['mass_kg']:.3f} kg ({about['mass_source']}), {size} cm, "
        f"{about['n_hulls']} hulls ({about['hull_source']}); at rest it drifts "
        f"{1000 * about['rest']['drift_hulls_m']:.2f} mm with hulls, "
        f"{1000 * about['rest']['drift_boxes_m']:.2f} mm with boxes",
        soft_wrap=True,
    )


def _check(arguments: argparse.Namespace, console: Console) -> int:
    from converters.check.gates import check_folder

    manifest, gates = check_folder(installed(arguments.scene))
    for gate in gates:
        verdict = "PASS" if gate.passed else "FAIL"
        print(
            f"{verdict}  {gate.name:<18} {gate.value:>10.5g} {gate.limit.unit:<6} limit {bounds(gate):<8} "
            f"({gate.limit.meaning})"
        )
    for warning in (w for gate in gates for w in gate.warnings):
        print(f"warning: {printable(warning)}")
    failed = sum(not g.passed for g in gates)
    print(f"{manifest.name}: {len(gates) - failed} of {len(gates)} gates pass")
    return 1 if failed else 0


def _preview(arguments: argparse.Namespace, console: Console) -> None:
    from converters.check.preview import preview

    preview(installed(arguments.scene), arguments.output, arguments.source)
    console.print(f"{arguments.output}: picture of {arguments.scene}", soft_wrap=True)


def _export(arguments: argparse.Namespace, console: Console) -> None:
    from converters.write.sh3d import export_sh3d

    for line in export_sh3d(installed(arguments.scene), arguments.output):
        console.print(f"{arguments.output}: {line}", soft_wrap=True, highlight=False)


def _propose(arguments: argparse.Namespace, console: Console) -> None:
    from converters.propose.report import propose
    from converters.propose.retrieval import read_library
    from converters.read.source import read_source

    with stage_progress(console) as report:
        raw, library = read_source(arguments.source, arguments.format), None
        if arguments.auto_align or arguments.library:
            library = read_library(arguments.library, arguments.source)
        proposed = propose(raw, arguments.output, library, report)
    for table in proposal_tables(proposed):
        console.print(table)
    console.print(f"{arguments.output}: proposals.json and proposals.png", soft_wrap=True)


def _annotate(arguments: argparse.Namespace, console: Console) -> int:
    from converters.annotate.browser import Page
    from converters.annotate.session import Store, start
    from converters.propose.proposals import propose_instances
    from converters.propose.retrieval import read_library
    from converters.read.source import read_source
    from interactive_nav_common.files import alone_in
    from interactive_nav_common.untrusted.guard import guarded_server

    with alone_in(arguments.output):
        raw = read_source(arguments.source, arguments.format, up=arguments.up, unit=arguments.unit)
        store = Store(arguments.output, read_library(arguments.library, arguments.source))
        proposals = propose_instances(raw.scan)
        session = store.save(store.open(raw, lambda: start(raw, proposals)))
        server, address = guarded_server(arguments.host, arguments.port, raw.name, "annotate")
        page = Page(server, store, session, raw, proposals)
        console.print(f"{address} (Ctrl-C ends it; every action is saved)", soft_wrap=True, highlight=False)
        try:
            threading.Event().wait()
        except KeyboardInterrupt as stop:
            number = number_of(stop)  # Ctrl-C is how it ends
        server.stop()
    states = [item.state for item in page.session.items]
    counts = ", ".join(f"{states.count(word)} {word}" for word in ("accepted", "skipped", "open"))
    console.print(f"{arguments.output}: {counts}", soft_wrap=True)
    return 0 if number == signal.SIGINT else 128 + number


RUNS: dict[str, Any] = {
    "convert": _convert,
    "propose": _propose,
    "annotate": _annotate,
    "object": _object,
    "check": _check,
    **GENERATING,
    **SEGMENTING,
    "preview": _preview,
    "export": _export,
}
"""Command of words.yaml -> what runs it, or its actions' table; an exit code where it is not always 0."""


def _add(commands: Commands, name: str, row: Command, run: Any) -> None:
    command = commands.add_parser(name, help=row.help, usage=row.usage)
    add_words(command, row.words, formats=("auto", *FORMATS), categories=CATEGORIES, cores=os.cpu_count() or 1)
    if not row.actions:
        command.set_defaults(run=run, writes=row.writes)
        return
    actions = command.add_subparsers(required=True, metavar="ACTION")
    for action, inner in row.actions.items():
        _add(actions, action, inner, run[action])


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="python -m converters", description="Raw scans to MuJoCo scene folders.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, row in read_commands(Path(__file__).with_name("words.yaml")).items():
        _add(commands, name, row, RUNS[name])
    convert = commands.choices["convert"]
    convert.fromfile_prefix_chars = "@"
    convert.convert_arg_line_to_args = lambda arg_line: [arg_line] if arg_line.strip() else []
    return parser


def _parse(argv: list[str] | None) -> argparse.Namespace:
    """Parse the command line's words; those of `generate` and `convert` may stand before and after its options."""
    parser = _parser()
    arguments, rest = parser.parse_known_args(argv)
    free = "settings" if "settings" in arguments else "places"
    if rest and (free not in arguments or any(word.startswith("-") for word in rest)):
        parser.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:
        setattr(arguments, free, [*getattr(arguments, free), *rest])
    if "places" in arguments:
        arguments.settings = [word for word in arguments.places if "=" in word and not Path(word).exists()]
        arguments.places = [word for word in arguments.places if word not in arguments.settings]
        if arguments.into:
            arguments.out, arguments.writes = arguments.into, ("{}/[!.]*",)
        elif len(arguments.places) == 2:
            arguments.source, arguments.out = map(Path, arguments.places)
        else:
            parser.error(f"convert: got {len(arguments.places)} folders, expected SRC OUT, or SRC... --into DIR")
    return arguments


def _standing(arguments: argparse.Namespace) -> dict[str, int]:
    """Return the inode by path where the command writes: it changes once something else is put there."""
    target = glob.escape(str(getattr(arguments, "out", None) or getattr(arguments, "output", "")))
    inodes = {}
    for path in (p for pattern in arguments.writes for p in glob.glob(pattern.format(target))):
        with contextlib.suppress(OSError):
            inodes[path] = os.stat(path).st_ino
    return inodes


@reports_errors("error")
@interrupts_heard(*STOPS)
def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = _parse(argv)
    console = SafeConsole()
    before = _standing(arguments)

    def written() -> str:
        new = sorted(path for path, inode in _standing(arguments).items() if before.get(path) != inode)
        return f"written before: {', '.join(new)}" if new else "nothing was written"

    try:
        if "launcher" in arguments and arguments.launcher != "ray":
            refuse_unused(arguments, "--ray-address", "without --launcher ray")
        return arguments.run(arguments, console) or 0
    except KeyboardInterrupt as stop:
        number = number_of(stop)
        print(f"{'interrupted' if number == signal.SIGINT else 'terminated'}; {written()}", file=sys.stderr)
        return 128 + number
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        where = error.filename or getattr(arguments, "out", None) or "file system"
        print(f"error: {where}: {error.strerror or error}; {written()}", file=sys.stderr)
        return 2
    except (UserError, StageFailed) as error:
        print("error: " + " ".join(str(error).split()), file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
