"""Format gates, alignments and proposals as tables for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
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
