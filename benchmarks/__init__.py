"""Speed measurements: programs that append rows to `benchmarks/results/`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
