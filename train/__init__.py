"""Configs in, trained policies, result rows and figures out; see `python -m train --help`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
