"""Packages that only an extra of this project brings: where one is missing, a line says how to install it.

The line holds in a checkout as well as beside a wheel: pip takes the project that is there, and adds the extra's.
"""

import importlib
from typing import Any

from interactive_nav_common.errors import ConfigError, UserError


class MissingPackage(ConfigError, ImportError):
    """A package of an extra cannot be imported."""


def missing(user: str, package: str, extra: str, otherwise: str = "") -> str:
    """The line: what needs the package, the extra that brings it, and another remedy."""
    return f"{user} needs {package}, which is not installed; pip install 'interactive-nav[{extra}]'{otherwise}"


def optional(module: str, line: str, kind: type[UserError] = MissingPackage) -> Any:
    """A module of an optional package.

    Raises:
        UserError: of this kind, with the line and what the import said; it cannot be imported.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise kind(f"{line} ({' '.join(str(error).split())})") from error
