"""Run `python -m train.figures RESULTS_DIR -o figures/`: draw metrics, rows and recorded paths; print tables."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from interactive_nav_common.commands import Command, Flag, option, parse, word
from interactive_nav_common.errors import FileError, reports_errors


class Draw(Command):
    """Draw figures of runs and sweeps, or print their tables."""

    results: Annotated[Path, *word("RESULTS_DIR")]
    """Run folder, sweep folder, or folder that contains some."""
    out: Annotated[Path, option("-o", metavar="DIR")] = Path("figures")
    """Folder to write the pictures to."""
    format: Literal["png", "pdf", "svg"] = "png"
    """File format of the pictures."""
    split: Literal["auto", "train", "test", "all"] = "auto"
    """Split of the scenes in a sweep's figures; auto takes test if there are rows of it."""
    tables: Flag = False
    """Print the tables of a sweep as Markdown instead of drawing figures."""
    table: Annotated[str | None, option(metavar="NAME")] = None
    """Print only the table with this heading, such as `scores`, `runs` or `the-paper-s-claims`."""


@reports_errors("train.figures")
def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(Draw, "python -m train.figures", argv)
    from interactive_nav_common.figures import RC, plt, save  # Matplotlib takes a second: --help does without
    from train.figures.results import SWEPT, Results, chosen_split, figures_of
    from train.figures.tables import document

    split = None if arguments.split == "all" else arguments.split
    if arguments.tables or arguments.table is not None:
        rows = Results(arguments.results).rows
        if not set(rows.column_names) >= SWEPT:
            raise FileError(
                f"{arguments.results}: no rows of policies; evaluate some first (python -m train.sweep FILE "
                "--only evaluate, or python -m train.evaluate)"
            )
        print(document(rows, chosen_split(rows, split), arguments.table), end="")
        return 0
    drawn = False
    for name, draw in figures_of(arguments.results, split):
        path = arguments.out / f"{name}.{arguments.format}"
        with plt.rc_context(RC):
            save(draw(), path, arguments.format)
        print(path)
        drawn = True
    if not drawn:
        raise FileError(f"{arguments.results}: nothing to draw (no rows and no recorded paths); expected a run folder")
    return 0


if __name__ == "__main__":
    sys.exit(main())
