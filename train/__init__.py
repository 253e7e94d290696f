"""Train policies from configs, and write result rows and figures; see `python -m train --help`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
