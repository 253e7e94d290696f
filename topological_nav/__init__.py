"""Scene folders in; rendered datasets, image networks, topological maps out; see `python -m topological_nav --help`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
