"""Run `python -m docs.studies.house`."""

import sys

from docs.studies.house import main

main(sys.argv[1:])
