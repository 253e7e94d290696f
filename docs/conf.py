"""Sphinx's settings: `make docs` builds this folder into docs/_build/html."""

import re
import sys
from pathlib import Path

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.ext.napoleon.docstring import GoogleDocstring

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
toc_object_entries_show_parents = "hide"
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


def keep_percentages(app, doctree, docname):
    """Keep each percent sign on the line of its number."""
    for text in list(doctree.findall(nodes.Text)):
        if not isinstance(text.parent, nodes.literal | nodes.literal_block | nodes.raw):
            together = re.sub(r"(?<=\d) (?=%)", "\N{NO-BREAK SPACE}", text)
            if together != text:
                text.parent.replace(text, nodes.Text(together))


def break_tables(app, doctree, docname):
    """Let long code in tables break between its words, and keep each interval `[low, high]` on one line."""
    for cell in doctree.findall(nodes.entry):
        for text in list(cell.findall(nodes.Text)):
            if not isinstance(text.parent, nodes.literal):
                together = re.sub(r"\[-?\d[^\]]*\]", lambda found: found[0].replace(" ", "\N{NO-BREAK SPACE}"), text)
                text.parent.replace(text, nodes.Text(together))
            elif len(text) > 16:
                first, *others = re.split(r"(?<=[_/,=])(?=[A-Za-z])|(?<=\.)(?=[A-Za-z]\w{3})", text)
                parts = [part for word in others for part in (nodes.raw("", "<wbr>", format="html"), nodes.Text(word))]
                text.parent.replace(text, [nodes.Text(first), *parts])


def shorten_signature(app, what, name, obj, options, signature, returns):
    """Leave out the signature of a class of settings, which would repeat all the fields below it."""
    return ("", returns) if what == "class" and len(signature or "") > 500 else None


def setup(app):
    """Register the renderer that `html_math_renderer` names, and what makes tables and the API readable."""
    # Napoleon takes an attribute's words before the first colon for its type.
    GoogleDocstring._parse_attribute_docstring = lambda docstring: list(docstring._lines)
    app.connect("doctree-resolved", keep_percentages)
    app.connect("doctree-resolved", break_tables)
    app.connect("autodoc-process-signature", shorten_signature)
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
