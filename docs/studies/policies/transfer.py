"""The picture of adaptation to a camera, from a run's rows and a few images.

    python -m topological_nav data scenes_mjcf/{alder,cedar,hazel} -o runs/look positions=12 max_per_room=1 \\
      headings=3 passage_sources=1 passage_targets=3
    python -m docs.studies.policies.transfer results/topological/full/features --data runs/look \\
      -o docs/topological-transfer.webp

Curves and scores are the run's own; the pairs of images show the domains, and need not be of its dataset.
"""

import argparse
import json
from pathlib import Path

from interactive_nav_common.records import read_metrics
from topological_nav.config import PITCHES
from topological_nav.data.dataset import load_rooms
from topological_nav.data.domains import PRESETS, as_seen
from topological_nav.figures.learning import features_figure
from topological_nav.figures.maps import save


def main() -> None:
    """Draws it."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("run", type=Path, help="folder with metrics.jsonl and results.json")
    words.add_argument("--data", type=Path, required=True, help="dataset to take images of")
    words.add_argument("--domain", default="camera")
    words.add_argument("-o", "--output", type=Path, required=True)
    given = words.parse_args()
    images = load_rooms(given.data).images[:, PITCHES.index("level"), 0]
    seen = as_seen(images, PRESETS[given.domain])
    results = json.loads((given.run / "results.json").read_text(encoding="utf-8"))
    save(
        features_figure(images, seen, read_metrics(given.run / "metrics.jsonl"), results),
        given.output,
        given.output.suffix[1:],
    )


if __name__ == "__main__":
    main()
