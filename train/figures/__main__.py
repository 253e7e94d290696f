"""`python -m train.figures`; see `train.figures.cli`."""

import sys

from train.figures.cli import main

if __name__ == "__main__":
    sys.exit(main())
