"""Settings of the documentation: Sphinx with MyST, ``make docs``."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from greenroof_ros import __version__

project = "greenroof_ros"
author = "greenroof_ros maintainers"
copyright = "the greenroof_ros maintainers, Apache-2.0"  # noqa: A001 - Sphinx's name for it
release = __version__

extensions = [
    "myst_parser",  # Markdown
    "sphinx.ext.autodoc",  # API pages from the docstrings ...
    "sphinx.ext.autosummary",  # ... one for each module ...
    "sphinx.ext.napoleon",  # ... whose sections are Google's
    "sphinx_copybutton",  # copies commands
]
exclude_patterns = ["_build", "_templates"]
templates_path = ["_templates"]

# A link that leads nowhere is an error (-W). Not documented here are names outside this package,
# private ones, type variables, and constants, which stand in the source with their comments.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!greenroof_ros).*"), (r"py:.*", r".*\._\w+"), (r"py:data", r".*"),
    (r"py:class", r".*\.plant\.Amount"),
]

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence", "attrs_inline"]
myst_heading_anchors = 4

html_theme = "furo"
html_math_renderer = "mathml"
html_title = f"greenroof_ros {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_theme_options = {"top_of_page_buttons": []}
# Only the prompt-free lines of a block are a command.
copybutton_exclude = ".linenos, .gp, .go"

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# Without a ROS 2 the nodes' pages are made all the same.
_ROS = ("rclpy", "std_msgs", "rosgraph_msgs", "diagnostic_msgs", "rcl_interfaces")
autodoc_mock_imports = [name for name in _ROS if importlib.util.find_spec(name) is None]

_SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields|Note|Example):$")
# What keeps its meaning in a docstring: ``code``, :role:`name` and `name`.
_MARKED = re.compile(r"(``.+?``|:[a-z:]+:`[^`]+`|`[^`]+`_?)", re.DOTALL)


def _as_text(line: str) -> str:
    """Return a line of a docstring in which stars and bars are those of mathematics."""
    parts = _MARKED.split(line)
    parts[::2] = [re.sub(r"(?<!\\)([*|]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def plain_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Make reStructuredText of a docstring, which is plain text with Google's sections.

    Before the first section an indented paragraph is a formula or code and kept as it is.
    """
    result: list[str] = []
    formula = section = False
    for line in lines:
        section = section or bool(_SECTION.match(line))
        indented = line.startswith("    ") and not section
        if indented and not formula:
            if result and result[-1]:
                result.append("")
            result.extend(["::", ""])
        if line.strip():
            if formula and not indented and result[-1]:
                result.append("")
            formula = indented
        result.append(line if formula else _as_text(line))
    lines[:] = result


def _visit_math(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node.astext()))
    raise nodes.SkipNode


def _visit_math_block(self: Any, node: nodes.math_block) -> None:
    formula = _mathml(node.astext()).replace("<math ", '<math display="block" ', 1)
    number = f'<span class="number">({node["label"]})</span>' if node.get("label") else ""
    self.body.append(f'<div class="math">{formula}{number}</div>')
    raise nodes.SkipNode


def _mathml(tex: str) -> str:
    """Return a formula as MathML, which browsers draw themselves: pages need no network."""
    return str(latex2mathml.tex2mathml(tex))


def setup(app: Sphinx) -> None:
    """Register the docstrings' reader and the formulas' writer."""
    app.connect("autodoc-process-docstring", plain_docstring, priority=100)  # before napoleon
    app.add_html_math_renderer("mathml", (_visit_math, None), (_visit_math_block, None))
