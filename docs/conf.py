"""Sphinx's settings: `make docs` builds this folder into docs/_build/html."""

import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

sys.path.insert(0, str(Path(__file__).parents[1]))

project = "interactive-nav"
author = "The interactive-nav authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode", "docs.program_help"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "interactive-nav"
html_static_path = ["site.css", "site.js"]
html_css_files = ["site.css"]
html_js_files = [("site.js", {"defer": "defer"})]
html_show_copyright = False
html_math_renderer = "mathml"
html_theme_options = {
    "light_css_variables": {
        "sidebar-caption-space-above": "0.5rem",
        "sidebar-item-line-height": "1.1rem",
        "sidebar-item-spacing-vertical": "0",
        "sidebar-tree-space-above": "0.75rem",
    }
}
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports = ["rsl_rl", "skrl", "stable_baselines3", "tensordict", "torch"]
napoleon_google_docstring = True
napoleon_numpy_docstring = False
suppress_warnings = ["ref.python"]
"""Fields of the same name in two records are distinguished by their place."""


def formula(page, node):
    """Write a formula as MathML, which browsers draw without a script, so that the site also works offline."""
    page.body.append(tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def setup(app):
    """Register the renderer that `html_math_renderer` names."""
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
