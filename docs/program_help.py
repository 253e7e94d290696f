"""Programs in, what their parsers say out, as a directive of Sphinx: the page of commands is made when it is built.

```{help-of} train.evaluate
```
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import io
import os
import re
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any
from unittest import mock

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

COLUMNS = 100


def help_of(module: str) -> dict[str, str]:
    """Return the help of `python -m module`, and of its commands, by the words that call them.

    Raises:
        ValueError: the program ends without printing help.
    """
    spec = importlib.util.find_spec(module)
    folder = spec is not None and spec.submodule_search_locations is not None
    program = importlib.import_module(f"{module}.__main__" if folder else module)
    texts = {}
    for words in ([], *_commands(getattr(program, "COMMANDS", {}))):
        wide = mock.patch.dict(os.environ, {"COLUMNS": str(COLUMNS), "NO_COLOR": "1"})
        with wide, contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.suppress(SystemExit):
            program.main([*words, "--help"])
        if not printed.getvalue():
            raise ValueError(f"{module}: no help; expected a program that prints it with --help")
        texts[" ".join(["python -m", module, *words])] = "\n".join(map(_wrapped, printed.getvalue().splitlines()))
    return texts


def _wrapped(line: str) -> str:
    """Return a line that is too long on several lines, indented as its description."""
    name = re.match(r" *(?:\S+ +(?=\S))?", line) if line.startswith("  ") else None
    return textwrap.fill(line, COLUMNS, subsequent_indent=" " * len(name[0] if name else "")) if line else line


def _commands(commands: Mapping[str, Any]) -> Iterator[list[str]]:
    """Yield the words of every command and of the commands below it."""
    for name, command in commands.items():
        yield [name]
        if isinstance(command, Mapping):
            yield from ([name, *below] for below in _commands(command))


class HelpOf(Directive):
    """A literal block for the program and for each of its commands."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        made: list[nodes.Node] = []
        for k, (words, text) in enumerate(help_of(self.arguments[0]).items()):
            made += [nodes.rubric(words, words)] if k else []
            made.append(nodes.literal_block(text, text, language="text"))
        return made


def setup(app: Sphinx) -> dict[str, bool]:
    """Sphinx's way in."""
    app.add_directive("help-of", HelpOf)
    return {"parallel_read_safe": True}
