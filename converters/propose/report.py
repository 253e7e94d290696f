"""Write `proposals.json` (Scan2CAD's shape) and `proposals.png` of a raw folder, and report on retrieval."""

import collections
import dataclasses
import json
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path

import numpy as np
from shapely import MultiPoint

from converters.bodies.alignment import apply_alignment
from converters.propose import retrieval
from converters.propose.proposals import Proposal, as_scan2cad, bounds, box_corners, box_iou, propose_instances
from converters.records.errors import SceneRejected
from converters.records.raw import CEILING, CadModel, RawScene
from converters.structure.floor import fit_floor
from interactive_nav_common.files import whole_file
from scenes_mjcf.categories import CATEGORIES

SAME_OBJECT_SHARE = 0.3
"""Share of a proposal's points in an annotated model's box from which they are compared."""


@dataclasses.dataclass(frozen=True)
class Proposed:
    """Result of `propose`."""

    proposals: tuple[Proposal, ...]
    retrieved: dict[int, retrieval.Retrieval]
    comparisons: tuple[retrieval.Comparison, ...]
    """Where the source has annotations and models were retrieved, one for each annotation that was proposed."""


def floor_of(raw: RawScene) -> float:
    """Return the height of the floor in the scan frame, m."""
    given = raw.floor_height_m
    return given if given is not None else fit_floor(raw.scan.vertices, raw.scan.faces, raw.scan.labels).height_m


def retrieve_sure(
    raw: RawScene, library_root: Path | None, progress: Callable[[float], None]
) -> tuple[tuple[Proposal, ...], dict[int, retrieval.Retrieval]]:
    """Return the furniture without an annotation, and by its index the model of a library where that is sure."""
    new = propose_instances(raw.scan)
    new = tuple(new[k] for k in retrieval.without_annotation(new, raw.annotations, raw.cads))
    retrieved = retrieval.auto_align(new, retrieval.read_library(library_root), floor_of(raw), progress) if new else {}
    return new, {k: retrieved[k] for k in sorted(retrieved) if retrieved[k].confidence >= retrieval.MIN_CONFIDENCE}


def given_up(proposals: Sequence[Proposal], sure: Container[int]) -> tuple[str, ...]:
    """Return one line that counts the furniture for which no model is sure, or none."""
    counts = collections.Counter(p.category for k, p in enumerate(proposals) if k not in sure)
    listed = ", ".join(f"{count} {category}" for category, count in sorted(counts.items()))
    return (f"no sure model, so part of the structure: {listed}",) if listed else ()


def with_retrieved(raw: RawScene, library_root: Path | None, progress: Callable[[float], None]) -> RawScene:
    """Add to the annotations what `retrieve_sure` finds, and to the warnings what it gives up."""
    proposals, sure = retrieve_sure(raw, library_root, progress)
    return dataclasses.replace(
        raw,
        annotations=raw.annotations + tuple(retrieval.as_annotation(r) for r in sure.values()),
        cads=raw.cads | {r.cad.cad_id: r.cad for r in sure.values()},
        warnings=raw.warnings + given_up(proposals, sure),
    )


def _draw(raw: RawScene, proposed: Proposed, target: Path) -> None:
    """Draw the scan from above, proposals as boxes with class and confidence, retrieved models as outlines."""
    import matplotlib  # 0.3 s that no conversion needs

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.patches import Patch, Polygon

    figure, axes = plt.subplots(figsize=(9, 9), dpi=110)
    keep = raw.scan.labels != CEILING
    vertices = raw.scan.vertices[keep]
    low = vertices[:, 2] < np.percentile(vertices[:, 2], 85)
    shade = "0.75"
    if raw.scan.vertex_colours is not None:
        shade = raw.scan.vertex_colours[keep][low] / 255.0
    axes.scatter(*vertices[low][:, :2].T, s=0.6, c=shade, alpha=0.5, linewidths=0)
    for k, proposal in enumerate(proposed.proposals):
        colour = CATEGORIES[proposal.category].preview_colour
        axes.add_patch(Polygon(box_corners(proposal), fill=False, edgecolor=colour, linewidth=2))
        text = f"{proposal.category} {proposal.confidence:.2f}"
        model = proposed.retrieved.get(k)
        if model is not None:
            outline = MultiPoint(apply_alignment(model.pose, model.cad.vertices)[:, :2]).convex_hull
            axes.add_patch(
                Polygon(np.asarray(outline.exterior.coords), fill=True, alpha=0.25, facecolor=colour, edgecolor=colour)
            )
            text += f"\nmodel {model.cad.cad_id[:6]} {model.confidence:.2f}"
        box = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1}
        x, y = proposal.centre[:2].tolist()
        axes.text(x, y, text, ha="center", va="center", fontsize=8, bbox=box)
    for annotation in raw.annotations:
        hull = MultiPoint(retrieval.annotated_vertices(annotation, raw.cads)[:, :2]).convex_hull
        axes.plot(*np.asarray(hull.exterior.coords).T, "k:", linewidth=1)
    shown = sorted({p.category for p in proposed.proposals})
    handles = [Patch(facecolor="none", edgecolor=CATEGORIES[c].preview_colour, label=c) for c in shown]
    handles.append(Patch(facecolor="none", edgecolor="black", linestyle=":", label="annotated model"))
    axes.legend(handles=handles, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.06), frameon=False)
    axes.set(aspect="equal", xlabel="x, m (scan frame)", ylabel="y, m (scan frame)")
    axes.set_title(f"{raw.name}: {len(proposed.proposals)} proposals, class and confidence")
    figure.tight_layout()
    figure.savefig(target, metadata={"Software": None})
    plt.close(figure)


def propose(
    raw: RawScene,
    target: Path,
    library: Mapping[str, CadModel] | None = None,
    report: Callable[[str, float], None] | None = None,
) -> Proposed:
    """Find instances, with a library of models by id also their models, and write both files into a folder.

    The folder is created if absent; on failure older files in it stay as they were. `report`: stage and share.
    """
    say = report or (lambda stage, share: None)
    say("propose", 0.0)
    proposals = propose_instances(raw.scan)
    if not proposals:
        raise SceneRejected(f"{raw.name}: no furniture label in the scan, expected NYU40 ids 5, 6, 7, 8, 14 or 39")
    retrieved: dict[int, retrieval.Retrieval] = {}
    comparisons = []
    if library is not None:
        floor = floor_of(raw)
        retrieved = retrieval.auto_align(proposals, library, floor, lambda share: say("retrieve", 0.1 + 0.8 * share))
        for annotation in raw.annotations:
            low, high = box = bounds(retrieval.annotated_vertices(annotation, raw.cads))
            at = max(range(len(proposals)), key=lambda i, box=box: box_iou(box, bounds(proposals[i].points)))
            share = ((proposals[at].points > low) & (proposals[at].points < high)).all(axis=1).mean()
            if share > SAME_OBJECT_SHARE and at in retrieved:
                comparisons.append(
                    retrieval.compare_retrieval(annotation, raw.cads, proposals[at], retrieved[at], floor)
                )
    proposed = Proposed(proposals, retrieved, tuple(comparisons))
    say("draw", 0.95)
    text = json.dumps(as_scan2cad(raw.name, proposals, retrieved), indent=1, allow_nan=False) + "\n"
    with whole_file(target / "proposals.json") as written, whole_file(target / "proposals.png") as picture:
        written.write_text(text, encoding="utf-8")
        _draw(raw, proposed, picture)
    say("draw", 1.0)
    return proposed
