"""The documentation says what is so: its Python runs, its commands parse, its options exist, its links lead somewhere.

Python blocks of one page run in order in one namespace, in a folder that holds the checked-in scenes and results. A
block is left out only where an HTML comment right before it says why: `<!-- not run: reason -->`.
"""

from __future__ import annotations

import contextlib
import functools
import http.server
import importlib
import importlib.util
import inspect
import io
import itertools
import re
import shlex
import sys
import threading
import traceback
import warnings
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import pytest
from markdown_it import MarkdownIt
from mdit_py_plugins.dollarmath import dollarmath_plugin
from sphinx.application import Sphinx

from interactive_nav.__main__ import PROGRAMS
from interactive_nav.config import make_config
from tests.converters.annotate.chromium import tab, until

ROOT = Path(__file__).parents[1]
README_WORDS = 700
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
GUIDES = [ROOT / name for name in ("CONTRIBUTING.md", "benchmarks/README.md", "scenes_mjcf/README.md")]
NOT_RUN = re.compile(r"<!--\s*not run:\s*(.+?)\s*-->", re.DOTALL)
HOUSE = ("interactive_nav", "train", "converters", "topological_nav", "benchmarks", "docs")


class Block(NamedTuple):
    language: str
    code: str
    line: int
    reason: str
    """Why it is not run; empty: it is."""


def blocks(text: str) -> list[Block]:
    """Fenced and indented blocks of a Markdown text."""
    found, reason = [], ""
    for token in MarkdownIt().parse(text):
        if token.type in ("fence", "code_block"):
            assert token.map is not None
            found.append(Block(token.info.strip(), token.content, token.map[0] + 1, reason))
        match = NOT_RUN.search(token.content) if token.type == "html_block" else None
        reason = match.group(1) if match else ""
    return found


def run_page(path: Path, text: str) -> int:
    """Runs a page's Python blocks; returns how many."""
    namespace: dict = {"__name__": "__docs__"}
    ran = 0
    for block in blocks(text):
        if block.language == "python" and not block.reason:
            lines = "\n" * block.line + block.code  # so that a traceback names the page's own line
            exec(compile(lines, str(path), "exec"), namespace)
            ran += 1
    return ran


def commands(text: str) -> list[tuple[str, list[str]]]:
    """Our programs in a page's shell blocks: (module, words)."""
    found = []
    for block in blocks(text):
        if block.language in ("sh", "bash", "shell", "console", ""):
            for line in block.code.replace("\\\n", " ").splitlines():
                if match := re.match(r"\s*(?:\$ )?(?:\w+=\S+ )*\S*python3? -m ([\w.]+)(.*)", line):
                    module, rest = match.groups()
                    if module.split(".")[0] in HOUSE:
                        found.append((module, shlex.split(rest, comments=True)))
                elif match := re.match(r"(?:.*\s)?interactive-nav ([a-z][\w-]*)(.*)", line.partition("#")[0]):
                    command, rest = match.groups()
                    module, _ = PROGRAMS[command]
                    found.append((module, [command] * (module == "converters") + shlex.split(rest)))
    return found


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder to run in: the scenes, and nothing else of the checkout."""
    for name in ("scenes_mjcf", "results"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)


# These read a robot file and a policy of the user's: tests/interactive_nav/robots/test_add_a_robot.py and
# tests/train/test_export.py write them and run the pages.
ELSEWHERE = ("add-a-robot.md", "from-a-checkpoint-to-a-robot.md")
# Half a minute each, for calls that README's and the other tests make too.
LONG = ("gymnasium.md", "sensors.md", "sweep.md", "videos.md")
with_python = [
    pytest.param(p, id=p.name, marks=[pytest.mark.heavy] if p.name in LONG else [])
    for p in PAGES
    if p.name not in ELSEWHERE and any(b.language == "python" for b in blocks(p.read_text(encoding="utf-8")))
]


def unprinted(text: str, printed: str) -> list[str]:
    """Lines of a page's tables of scores (a robot or task, then a policy) that its code did not begin a line with."""
    row = re.compile(r"\| ((TurtleBot|Fetch),|`\w+`|generated,).*\d\.\d{3}")
    lines = (line for line in text.splitlines() if row.match(line))
    return [line for line in lines if not any(out.startswith(line) for out in printed.splitlines())]


@pytest.mark.parametrize("page", with_python)
def test_python_of_a_page_runs(page, capsys):
    text = page.read_text(encoding="utf-8")
    assert run_page(page, text) > 0
    if page.name in ("results.md", "results-cluttered.md", "results-planners.md", "results-tasks.md"):
        printed = capsys.readouterr().out
        row = "| `clear` | fetch, `follower` | " if page.name == "results-tasks.md" else "| Fetch, `follower` | "
        assert unprinted(text, printed) == [] and f"\n{row}" in text
        wrong = text.replace(row, f"{row}1", 1)
        assert len(unprinted(wrong, printed)) == 1


def test_a_page_with_a_wrong_line_fails():
    text = "# A\n\n```python\nx = 1\n```\n\nand\n\n```python\nassert x == 2\n```\n"
    with pytest.raises(AssertionError) as failure:
        run_page(Path("a.md"), text)
    assert traceback.extract_tb(failure.tb)[-1].lineno == 10
    assert run_page(Path("a.md"), text.replace("== 2", "== 1")) == 2
    left_out = text.replace("and\n", "<!-- not run: needs two machines -->")
    assert [b.reason for b in blocks(left_out)] == ["", "needs two machines"]
    assert run_page(Path("a.md"), left_out) == 1


def help_of(module: str, words: list[str]) -> str:
    """The help of a program, or of the subcommand that the words name."""
    name = (
        f"{module}.__main__"
        if getattr(importlib.util.find_spec(module), "submodule_search_locations", None)
        else module
    )
    main = importlib.import_module(name).main
    sub = list(itertools.takewhile(lambda word: re.fullmatch(r"[a-z][a-z-]*", word), words[:2]))  # or a place it takes
    out = io.StringIO()
    argv = [module, *sub, "--help"]
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit), patch.object(sys, "argv", argv):
        main(*([argv[1:]] if inspect.signature(main).parameters else []))
    return out.getvalue()


def unknown_flags(text: str) -> list[str]:
    """'module --flag' for every flag in a page's commands that the program's help does not name."""
    wrong, helps = [], {}
    for module, words in commands(text):
        flags = [w.partition("=")[0] for w in words if re.match(r"--?[a-z]", w)]
        key = (module, *words[:2])
        if flags and key not in helps:  # a study without flags would run
            helps[key] = help_of(module, words)
        wrong += [f"{module} {flag}" for flag in flags if not re.search(rf"(?<![\w-]){flag}(?![\w-])", helps[key])]
    return wrong


@pytest.mark.parametrize("page", [*PAGES, *GUIDES], ids=str)
def test_commands_of_a_page_exist(page):
    assert unknown_flags(page.read_text(encoding="utf-8")) == []


def test_an_unknown_flag_is_found():
    text = "```sh\npython -m train.evaluate RUN --episodes 3 --episode 3\n```\n"
    assert unknown_flags(text) == ["train.evaluate --episode"]
    wheel = "```sh\nuvx --from x interactive-nav preview alder -o a.png  # --as\ninteractive-nav train --confg a\n```\n"
    assert commands(wheel)[0] == ("converters", ["preview", "alder", "-o", "a.png"])
    assert unknown_flags(wheel) == ["train --confg"]
    assert unknown_flags("Indented:\n\n    python -m train --confg a\n") == ["train --confg"]


def shared_runs(text: str) -> list[str]:
    """Run folders that commands share: the second is refused."""
    runs, wrong = {}, []
    for module, words in commands(text):
        if module == "train" and "--config" in words and "--print-config" not in words:
            given = dict(word.split("=", 1) for word in words if "=" in word)
            config = words[words.index("--config") + 1]
            run = given.get("run.name") or f"{config}-seed{given.get('run.seed', '0')}"
            wrong += [run] if runs.setdefault(run, words) != words else []
    return wrong


@pytest.mark.parametrize("page", [*PAGES, *GUIDES], ids=str)
def test_runs_of_a_page_are_apart(page):
    assert shared_runs(page.read_text(encoding="utf-8")) == []


def test_a_shared_run_folder_is_found():
    demo = "```sh\npython -m train --config demo\n```\n"
    assert shared_runs(demo + demo + demo.replace("demo", "demo run.seed=1")) == []
    assert shared_runs(demo + demo.replace("demo", "demo env.k_int=1")) == ["demo-seed0"]


def options(text: str) -> list[tuple[str, str]]:
    """Settings that a text names as `option=value`, in backticks on their own."""
    return re.findall(r"`(\w+)=([^`\s]+)`", text)


def test_options_that_the_benchmarks_page_names_exist():
    named = options((ROOT / "docs" / "benchmark.md").read_text(encoding="utf-8"))
    assert len(named) > 15
    for name, value in named:
        config = make_config(**{name: eval(value)})
        assert getattr(config, name) != getattr(make_config(), name), f"{name}={value} is the default"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_to_files(page):
    links = re.findall(r"\]\((?!https?://|#)([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_the_readme_links_every_page():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"(\[)?`((?:docs|benchmarks)/[\w./-]+\.md|CITATION\.cff)`(\]\(\S+?\))?", text)
    assert [name for first, name, link in named if (first, link) != ("[", f"]({name})")] == []
    assert {str(p.relative_to(ROOT)) for p in PAGES[1:]} <= set(re.findall(r"\]\((docs/[\w-]+\.md)", text))


def test_nobody_is_sent_to_an_address_that_does_not_exist():
    pages = [*PAGES, ROOT / "CITATION.cff", ROOT / "pyproject.toml", ROOT / "CONTRIBUTING.md"]
    assert [p.name for p in pages if re.search(r"example\.(org|com|net)", p.read_text(encoding="utf-8"))] == []


ROOMS = (*HOUSE, "interactive_nav_common", "results", "scenes_mjcf", "tests")
A_PATH = re.compile(rf"(?<![\w./$-])(?:{'|'.join(ROOMS)})/[\w./-]*\w(?![\w$<{{*-])")
MADE = re.compile(r"scenes_mjcf/(?:furnished|cluttered)/\w+_\d|scenes_mjcf/(?:my_|homes\d)|docs/_build|/[A-Z]+(?:/|$)")
"""Made by a command, or a place that the reader fills: `scenes_mjcf/NAME`."""
FOREIGN = {"benchmarks/kitchen"}
"""In the repository of `mujoco_warp`."""
PROSE = [
    *PAGES,
    *GUIDES,
    *sorted(p for room in ROOMS if room != "tests" for p in ROOT.glob(f"{room}/**/*.py")),
]


def missing_paths(text: str, page: Path) -> list[str]:
    """Files and folders of this repository that a text names, from the root or its folder, and that do not exist."""
    named = {path for path in A_PATH.findall(text) if not MADE.search(path)} - FOREIGN
    places = {path: (ROOT / path, page.parent / path, ROOT / f"{path}.py") for path in named}
    return sorted(path for path, tried in places.items() if not any(place.exists() for place in tried))


def test_paths_that_are_named_exist():
    wrong = {p.relative_to(ROOT): missing_paths(p.read_text(encoding="utf-8"), p) for p in PROSE}
    assert {page: paths for page, paths in wrong.items() if paths} == {}


def test_a_path_that_is_gone_is_found():
    text = (
        "`tests/test_docs.py`, `tests/gone/test_docs.py::test_a`, `train/configs`, `train/a.yaml`, `scenes_mjcf/NAME`"
    )
    assert missing_paths(text, ROOT / "README.md") == ["tests/gone/test_docs.py", "train/a.yaml"]


def test_tests_that_are_named_exist():
    defined = "\n".join(p.read_text(encoding="utf-8") for p in ROOT.glob("tests/**/test_*.py"))
    pages = "\n".join(p.read_text(encoding="utf-8") for p in [*PAGES, *GUIDES])
    named = set(re.findall(r"`(test_\w+_\w+)`", pages))
    assert len(named) > 3
    assert {name for name in named if f"def {name}(" not in defined} == set()


def test_the_readme_is_read_in_three_minutes():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= README_WORDS


def words_a_sentence(text: str) -> float:
    """Mean over a page's sentences; code, tables and fragments of three words do not count."""
    lengths, table = [], False
    for token in MarkdownIt().enable("table").parse(text):
        table = token.type == "table_open" or (table and token.type != "table_close")
        if token.type == "inline" and not table:
            line = re.sub(r"`[^`]*`", "x", re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", token.content)).replace("\n", " ")
            lengths += [
                len(re.findall(r"\w+(?:[.,'/-]\w+)*", s)) for s in re.split(r"(?<=[.!?])\s+(?=[A-Z*`x\d\[(])", line)
            ]
    lengths = [n for n in lengths if n > 3]
    return sum(lengths) / max(len(lengths), 1)


def test_words_of_a_sentence_are_counted():
    assert words_a_sentence("One two three four five. One two three `a b` four.\n\n| a b c d e |\n|---|\n| x |\n") == 5


@pytest.mark.parametrize("page", [*PAGES, *GUIDES], ids=str)
def test_sentences_are_short(page):
    assert words_a_sentence(page.read_text(encoding="utf-8")) <= 22


def from_the_network(html: str) -> list[str]:
    """Scripts, styles, pictures and frames that a page loads from elsewhere."""
    return re.findall(r"<(?:script|link|img|source|iframe)\b[^>]*\s(?:src|href)=[\"']((?:https?:)?//[^\"']+)", html)


def formulas(text: str) -> list[str]:
    """TeX of a page's formulas."""
    top = MarkdownIt().use(dollarmath_plugin).parse(text)
    return [t.content for token in top for t in (token, *(token.children or ())) if t.type.startswith("math_")]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the documentation as HTML."""
    docs, made = ROOT / "docs", tmp_path_factory.mktemp("site")
    left_out = {"exclude_patterns": ["_build", "api.md", "commands.md"]}  # these import or run every program
    with warnings.catch_warnings(action="ignore"):  # of MyST's use of Sphinx
        Sphinx(docs, docs, made, made / "trees", "html", left_out, status=None, warning=None).build()
    return made


def test_the_site_works_without_network(site):
    pages = {page.name: page.read_text(encoding="utf-8") for page in site.glob("*.html")}
    assert {name: found for name, html in pages.items() if (found := from_the_network(html))} == {}
    sources = {f"{p.stem}.html": len(formulas(p.read_text(encoding="utf-8"))) for p in PAGES[1:]}
    drawn = {name: len(re.findall(r"<math\b.*?</math>", html, re.DOTALL)) for name, html in pages.items()}
    assert {name: count for name, count in drawn.items() if count} == {n: c for n, c in sources.items() if c}
    # One half, which docutils reads as twelve over the parenthesis where its braces are left out.
    assert re.search(r"<mfrac>\s*<mn>1</mn>\s*<mn>2</mn>\s*</mfrac>", pages["benchmark.html"])


def test_a_page_that_loads_from_the_network_is_found():
    cdn = "https://cdn.jsdelivr.net/npm/mathjax@4/tex-mml-chtml.js"
    html = f'<script defer="defer" src="{cdn}"></script><script src="_static/site.js"></script><a href="{cdn}">a</a>'
    assert from_the_network(html) == [cdn]
    assert formulas("$a_1$ for `$S`\n\n```sh\necho $HOME $S\n```\n\n$$\nb\n$$\n") == ["a_1", "\nb\n"]


FAULTS = """
(async () => {
  const frame = document.createElement("iframe");
  frame.style = "position: fixed; inset: 0; width: 1400px; height: 900px";
  frame.src = "PAGE";
  document.body.append(frame);
  await new Promise(done => frame.onload = done);
  const page = frame.contentDocument, faults = [];
  const scrolls = [...page.querySelectorAll(".table-wrapper")].filter(table => table.scrollWidth > table.clientWidth);
  faults.push(...scrolls.map(table => "scrolls at 1400 px: " + table.textContent.trim().slice(0, 40)));
  const menu = page.querySelector(".sidebar-scroll");
  if (menu && menu.scrollHeight > menu.clientHeight) faults.push("the sidebar is higher than 900 px");
  faults.push(...[...page.images].filter(i => !i.naturalWidth).map(i => "no picture: " + i.getAttribute("src")));
  frame.style.width = "400px";
  if (page.documentElement.scrollWidth > 400) faults.push("wider than 400 px");
  const drawings = [...page.images].filter(i => i.src.endsWith(".svg") && i.clientWidth < i.naturalWidth);
  faults.push(...drawings.map(i => "shrunk at 400 px: " + i.getAttribute("src")));
  frame.remove();
  return faults;
})()
"""


def test_pages_fit_wide_and_narrow_windows(site, tmp_path):
    wide = '<div class="table-wrapper" style="overflow: auto"><p style="width: 1500px">A row</p></div>'
    drawing = '<svg xmlns="http://www.w3.org/2000/svg" width="720" height="9"></svg>'
    (site / "small.svg").write_text(drawing, encoding="utf-8")
    shrunk = '<img src="small.svg" style="max-width: 100%">'
    page = f'<!doctype html>{wide}<img src="gone.png">{shrunk}<p style="width: 500px">A line'
    (site / "wrong.html").write_text(page, encoding="utf-8")
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with tab(f"http://127.0.0.1:{server.server_address[1]}/index.html", tmp_path / "profile") as browser:
                until(lambda: browser.evaluate("document.readyState === 'complete'"), what="the page")
                found = {}
                for page in site.glob("*.html"):
                    script = FAULTS.replace("PAGE", page.name)
                    result = browser.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
                    found[page.name] = result["result"]["value"]
        finally:
            server.shutdown()
    wrong = ["scrolls at 1400 px: A row", "no picture: gone.png", "wider than 400 px", "shrunk at 400 px: small.svg"]
    assert len(found) > 50
    assert {page: faults for page, faults in found.items() if faults} == {"wrong.html": wrong}


def test_tables_keep_intervals_together_and_let_code_break(site):
    cells = re.findall(r"<td>.*?</td>", (site / "design.html").read_text("utf-8"), re.DOTALL)
    assert any(">jax_</span><wbr><span" in cell for cell in cells)
    cells = re.findall(r"<td>.*?</td>", (site / "tables-cluttered.html").read_text("utf-8"), re.DOTALL)
    intervals = [found for cell in cells for found in re.findall(r"\[-?\d[^]]*\]", cell)]
    assert len(intervals) > 100
    assert [interval for interval in intervals if ",\N{NO-BREAK SPACE}" not in interval] == []


def test_percent_signs_stay_with_their_numbers(site):
    text = re.sub(r"<pre>.*?</pre>", "", (site / "results.html").read_text("utf-8"), flags=re.DOTALL)
    assert "97\N{NO-BREAK SPACE}%" in text and re.findall(r"\d %", text) == []
