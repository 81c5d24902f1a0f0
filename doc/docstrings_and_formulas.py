"""Sphinx extension: docstrings are plain text, and formulas are MathML."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml
from sphinx.application import Sphinx

_SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields|Note|Example):$")
# Keeps its meaning in a docstring: ``code``, :role:`name` and `name`.
_MARKED = re.compile(r"(``.+?``|:[a-z:]+:`[^`]+`|`[^`]+`_?)", re.DOTALL)


def _as_text(line: str) -> str:
    """Return a line of a docstring with stars and bars escaped, because they are mathematics."""
    parts = _MARKED.split(line)
    parts[::2] = [re.sub(r"(?<!\\)([*|]|_(?=\W|$))", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def plain_docstring(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """Convert a docstring from plain text with Google's sections to reStructuredText.

    An indented paragraph before the first section is a formula or code, and is kept.
    """
    result: list[str] = []
    formula = section = False
    for line in lines:
        section = section or bool(_SECTION.match(line))
        indented = line.startswith("    ") and not section
        if line.strip():
            if indented and not formula:
                if result and result[-1].endswith("::"):
                    result.append("")
                else:
                    result.extend(["", "::", ""])
            elif formula and not indented:
                result.append("")
            formula = indented
        result.append(line if formula else _as_text(line))
    lines[:] = result


def _visit_math(self: Any, node: nodes.math) -> None:
    self.body.append(_mathml(node.astext()))
    raise nodes.SkipNode


def _visit_math_block(self: Any, node: nodes.math_block) -> None:
    """Write a formula on a line of its own."""
    formula = _mathml(node.astext()).replace("<math ", '<math display="block" ', 1)
    self.body.append(f'<div class="math">{formula}</div>')
    raise nodes.SkipNode


def _mathml(tex: str) -> str:
    """Return a formula as MathML, which browsers draw themselves, so pages need no network."""
    return str(latex2mathml.tex2mathml(tex))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the docstrings' reader and the formulas' writer."""
    app.connect("autodoc-process-docstring", plain_docstring, priority=100)  # before napoleon
    app.add_html_math_renderer("mathml", (_visit_math, None), (_visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
