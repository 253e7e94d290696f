"""Make datasets of images, networks and topological maps of scene folders; see `python -m topological_nav --help`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
