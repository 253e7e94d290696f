"""Run `interactive-nav report RESULTS... -o report.html`: write one HTML file, readable offline, of rows and runs."""

import base64
import html
import io
import re
import string
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from interactive_nav_common.commands import Command, option, parse, word
from interactive_nav_common.config import Natural
from interactive_nav_common.errors import UserError, reports_errors
from interactive_nav_common.files import write_text
from train.scoring import LEARNED, PLANNERS, POLICIES

if TYPE_CHECKING:
    from rich.console import Console

    from train.figures.results import Results

KINDS = {LEARNED: "run"} | dict.fromkeys(POLICIES[1:], "baseline")
KINDS |= {name.partition(":")[0]: "planner" for name in PLANNERS}
"""Policies that the project has; any other is the user's."""
GROUPS = (
    ("Learning curves", ("learning_curves",), "no metrics.jsonl is here; give the folder that train wrote, too"),
    ("Path and effort efficiency", ("path_effort", "frontier", "robots"), "no rows are here; play some: {evaluate}"),
    ("Trajectories", ("trajectories",), "no paths are here; record some: {evaluate} --record 8"),
    ("More figures", ("",), ""),
)
"""Heading, the names that figures of it begin with, and what to do where there are none."""
EVALUATE = "python -m train.evaluate RUN_DIR"
LARGEST_SVG = 300_000
"""Bytes; a figure of thousands of dots is smaller as pixels."""
FILM_FRAMES = 150


class Report(Command):
    """Write one HTML file, readable offline, with the results of runs and sweeps."""

    results: Annotated[tuple[Path, ...], *word("RESULTS")]
    """Run folders, sweep folders, folders that contain some, or files of rows. Each becomes a part of the report."""
    out: Annotated[Path, option("-o", metavar="FILE")] = Path("report.html")
    """HTML file to write."""
    split: Literal["auto", "train", "test", "all"] = "auto"
    """Split of the scenes in a sweep's figures; auto takes test if there are rows of it."""
    films: Natural = 1
    """Number of films of the best replays in each part, and of the worst."""


def table(header: Sequence[str], lines: Sequence[Sequence[Any]], sorted_by: int | None = None) -> str:
    """Return a table; a cell is a text, or (text, number to sort by). With `sorted_by`, clicks on its head sort it."""
    numbers = [bool(lines) and isinstance(cell, tuple) for cell in (lines or [header])[0]]
    head = ""
    for k, name in enumerate(map(html.escape, header)):
        name = name if sorted_by is None else f"<button>{name}</button>"
        order = "" if sorted_by is None else f' aria-sort="{"descending" if k == sorted_by else "none"}"'
        head += f'<th scope="col"{order}{" class=number" * numbers[k]}>{name}</th>'
    body = "".join(f"<tr>{''.join(map(_cell, line))}</tr>\n" for line in lines)
    kind = "" if sorted_by is None else ' class="sortable"'
    return f'<div class="table"><table{kind}><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>\n'


def _cell(cell: Any) -> str:
    if isinstance(cell, tuple):
        return f'<td data-value="{cell[1]:.6g}">{html.escape(cell[0])}</td>'
    return f"<td{' class=long' * (len(cell) > 60)}>{html.escape(cell)}</td>"


def leaderboard(rows: Any, source: str) -> list[tuple[Any, ...]]:
    """Return a line for each policy of each run and split: its place, kind and mean scores with 95 % intervals."""
    from interactive_nav_common.rows import where
    from interactive_nav_common.statistics import over_episodes
    from train.figures.style import robot_name
    from train.figures.tables import SPLITS
    from train.scoring.rows import SCORES

    keys = ("run", "policy", "robot", "split")
    if not {*keys, *SCORES} <= set(rows.column_names):
        return []
    lines = []
    for run, policy, robot, split in sorted(set(zip(*(rows[key].to_pylist() for key in keys), strict=True))):
        part = where(rows, run=run, policy=policy, robot=robot, split=split)
        scores = [over_episodes(name, part[name].to_numpy()) for name in SCORES]
        name = run if policy == LEARNED else policy
        kind = KINDS.get(policy.partition(":")[0], "user's policy")
        cells = ((estimate.with_ends(), estimate.mean) for estimate in scores)
        place = (source, name, kind, robot_name(robot), SPLITS.get(split, split))
        lines.append((*place, *cells, (f"{len(part):,}", len(part))))
    return lines


def _board(lines: list[tuple[Any, ...]]) -> str:
    """Return the section of the leaderboard, best INS_0.5 first."""
    from train.scoring.rows import SCORES

    header = ("results", "run or policy", "kind", "robot", "scenes", *SCORES.values(), "episodes")
    at = header.index("INS_0.5")
    words = "A click on a column sorts by it. Mean over episodes [95 % interval]: Wilson for success, else bootstrap."
    lines = sorted(lines, key=lambda line: -line[at][1])
    if len({line[0] for line in lines}) == 1:
        header, lines, at = header[1:], [line[1:] for line in lines], at - 1
    text = f'<h2 id="leaderboard">Leaderboard</h2>\n<p>{words} They say how well one policy is measured, not what '
    text += (
        'another seed would score.</p>\n<input id="filter" type="search" aria-label="Filter" placeholder="Filter">\n'
    )
    missing = f"<h2>Leaderboard</h2>\n<p>No rows of policies are here; play some: <code>{EVALUATE}</code></p>\n"
    return text + table(header, lines, at) if lines else missing


def _scores(files: "Results", split: str | None) -> Iterator[str]:
    """Yield the tables of `train.figures --tables`, the first one open; claims only where several runs are compared."""
    from train.figures.results import SWEPT
    from train.figures.tables import sections

    parts = sections(files.rows, split) if set(files.rows.column_names) >= SWEPT else []
    parts = [part for part in parts if files.swept or not part[2].startswith("| claim")]
    for k, (heading, words, markdown) in enumerate(parts):
        header, _, *lines = [line.strip("| ").split(" | ") for line in markdown.splitlines()]
        words = f"<p>{html.escape(words)}</p>\n" if words else ""
        yield f"<details{' open' * (k == 0)}><summary>{heading}</summary>\n{words}{table(header, lines)}</details>\n"


def _picture(name: str, figure: Any) -> str:
    """Return a figure as an inlined SVG, or as WebP where that is smaller."""
    from interactive_nav_common.figures import plt

    wide, kind, data = bool(figure.get_figwidth() > 6.5), "svg+xml", io.BytesIO()
    figure.savefig(data, format="svg", metadata={"Date": None})
    if data.tell() > LARGEST_SVG:
        kind, data = "webp", io.BytesIO()
        figure.savefig(data, format="webp", dpi=160, pil_kwargs={"quality": 85})
    size = [round(110 * inches) for inches in figure.get_size_inches()]
    plt.close(figure)
    about, data = html.escape(name.replace("_", " ")), base64.b64encode(data.getvalue()).decode()
    image = f'<img width="{size[0]}" height="{size[1]}" alt="{about}" src="data:image/{kind};base64,{data}">'
    place = f'<figure class="figure{" wide" * wide}"><div class="scroll">{image}</div>'
    return f"{place}<figcaption>{about}</figcaption></figure>\n"


def _films(files: "Results", count: int, console: "Console") -> Iterator[str]:
    """Yield films of the best and the worst replays by INS_0.5, or a sentence where one cannot be drawn."""
    paths = [path for path in files.records if path.parent.name == "replays"]
    if not paths or not count:
        return
    from interactive_nav.pictures.replay import load_replay
    from interactive_nav.record import Compositor, write_video
    from interactive_nav.scenes.scene import load_scene

    scored = sorted((load_replay(path).metrics["ins_0.5"], path) for path in paths)
    worst = scored[: min(count, len(scored) - 1)]
    best = [pair for pair in scored[::-1][:count] if pair not in worst]
    for kind, (score, path) in [*(("best", pair) for pair in best), *(("worst", pair) for pair in worst)]:
        replay = load_replay(path)
        with tempfile.TemporaryDirectory() as folder, console.status(f"filming {path.stem}"):
            film = Path(folder) / "film.mp4"
            try:
                every = -(-replay.num_steps // FILM_FRAMES)
                write_video(Compositor(replay, load_scene(replay.scene), 240), film, every)
            except UserError as error:
                yield f"<p>{html.escape(f'{path.name}: no film ({error})')}</p>\n"
                continue
            data = base64.b64encode(film.read_bytes()).decode()
        end = "reaches the goal" if replay.metrics["success"] else "does not reach the goal"
        place = f"episode {replay.episode} in {Path(replay.scene).name}"
        about = f"{kind}: {replay.policy}, {place}, {end}, INS_0.5 {score:.3f}"
        source = f'<video controls muted loop playsinline src="data:video/mp4;base64,{data}"></video>'
        yield f"<figure>{source}<figcaption>{html.escape(about)}</figcaption></figure>\n"


def _part(files: "Results", split: str | None, films: int, console: "Console") -> Iterator[str]:
    """Yield the tables, figures and films of one folder."""
    from interactive_nav_common.figures import RC, plt
    from train.figures.results import SWEPT, chosen_split, figures_of

    shown = chosen_split(files.rows, split) if set(files.rows.column_names) >= SWEPT else split
    scores = "".join(_scores(files, shown))
    missing = "no rows of policies are here; play some: {evaluate}"
    contents = {"Score tables": (scores, missing), **{heading: ("", words) for heading, _, words in GROUPS}}
    for name, draw in figures_of(files, shown):
        heading = next(heading for heading, names, _ in GROUPS if name.startswith(names))
        with console.status(f"drawing {name}"), plt.rc_context({**RC, "svg.hashsalt": name}):
            contents[heading] = (contents[heading][0] + _picture(name, draw()), contents[heading][1])
    missing = "no replays are here; record an episode: python -m train.record RUN_DIR --episode 0"
    contents["Films"] = ("".join(_films(files, films, console)), missing if films else "--films is 0")
    for heading, (content, words) in contents.items():
        if content and heading != "Score tables":
            content = f'<div class="figures">\n{content}</div>\n'
        if content or words:
            words = re.sub("([a-z-]+ -m .*)", r"<code>\1</code>", html.escape(words.format(evaluate=EVALUATE)))
            yield f"<h3>{heading}</h3>\n{content or f'<p>None: {words}.</p>'}\n"


def page(results: Sequence[Path], split: str | None, films: int, console: "Console") -> str:
    """Return the whole report."""
    from train.figures.results import Results

    lines, parts, links = [], "", '<a href="#leaderboard">Leaderboard</a>'
    for k, root in enumerate(results):
        files, name = Results(root), html.escape(str(root))
        lines += leaderboard(files.rows, str(root))
        columns = [c for c in ("commit", "device", "backend") if c in files.rows.column_names]
        facts = [f"{c}: {', '.join(sorted({str(x)[:40] for x in files.rows[c].to_pylist()}))}" for c in columns]
        facts = [f"episodes: {len(files.rows):,}", f"learning curves: {len(files.curves)}", *facts]
        links += f' <a href="#part{k}">{name}</a>'
        parts += f'<h2 id="part{k}">{name}</h2>\n<p>{html.escape("; ".join(facts))}</p>\n'
        parts += "".join(_part(files, split, films, console))
    title = html.escape(", ".join(root.resolve().name for root in results))
    body = f"<h1>{title}</h1>\n<nav>{links}</nav>\n{_board(lines)}{parts}"
    template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return string.Template(template).substitute(title=f"{title}: report", body=body)


@reports_errors("train.figures.report")
def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(Report, "python -m train.figures.report", argv)
    from interactive_nav_common.jobs.progress import SafeConsole

    console = SafeConsole()
    split = None if arguments.split == "all" else arguments.split
    text = page(arguments.results, split, arguments.films, console)
    write_text(arguments.out, text)
    console.print(f"{arguments.out}: {len(text) / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
