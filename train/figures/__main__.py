"""`python -m train.figures`; see `train.figures.cli`."""

from __future__ import annotations

import sys

from train.figures.cli import main

if __name__ == "__main__":
    sys.exit(main())
