"""Programs in, what their parsers say out, as a directive of Sphinx: the page of commands is made when it is built.

```{help-of} train.evaluate
```
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import inspect
import io
import os
import sys
from unittest import mock

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

COLUMNS = 100


def help_of(module: str) -> dict[str, str]:
    """What `python -m module --help` says, and its commands say, by the words that call them.

    Raises:
        ValueError: the program ends without printing help.
    """
    found = importlib.util.find_spec(module)
    folder = found is not None and found.submodule_search_locations is not None
    main = importlib.import_module(f"{module}.__main__" if folder else module).main
    caught: list[argparse.ArgumentParser] = []
    with (
        mock.patch.object(argparse.ArgumentParser, "print_help", lambda self, file=None: caught.append(self)),
        mock.patch.object(sys, "argv", [f"python -m {module}", "--help"]),
        contextlib.redirect_stdout(io.StringIO()) as printed,
        contextlib.suppress(SystemExit),
    ):
        main(*([["--help"]] if inspect.signature(main).parameters else []))
    if caught:
        return of_parser(caught[0])
    if not printed.getvalue():
        raise ValueError(f"{module}: no help; expected a program that prints it with --help")
    return {f"python -m {module}": printed.getvalue()}


def of_parser(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Help of a parser and of the commands below it, 100 columns wide."""
    with mock.patch.dict(os.environ, {"COLUMNS": str(COLUMNS), "NO_COLOR": "1"}):
        told = {parser.prog: parser.format_help()}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in dict.fromkeys(action.choices.values()):
                told |= of_parser(below)
    return told


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
