"""Configs in, trained policies, result rows and figures out; see `python -m train --help`."""

# First: it sets how JAX compiles constants, which JAX reads once, when it is imported.
import interactive_nav  # noqa: F401
from interactive_nav_common.moved import keep_old_names

# What was documented before packages had rooms; new code uses the new names.
keep_old_names(
    {
        "train.learner": "train.learners.learner",
        "train.networks": "train.learners.networks",
        "train.planners": "train.scoring.planners",
        "train.policies": "train.scoring.policies",
        "train.rows": "interactive_nav_common.rows",
    }
)
