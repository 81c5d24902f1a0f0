"""Pages for people: an answer, and sections with texts, tables and pictures, in one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jinja2

from greenroof_ros.analysis.figures import Figure
from greenroof_ros.analysis.tables import Table
from greenroof_ros.base.files import add_path_to_errors, claim_directory
from greenroof_ros.base.versions import format_versions, versions

FIGURES = "figures"
"""folder of the figures in the folder of an output"""

Part = str | Sequence[str] | Table | Figure
"""part of a section: a paragraph, a list, a table or a figure"""


class Section(NamedTuple):
    """A section of a page."""

    title: str
    parts: Sequence[Part]
    folded: bool = False
    """whether a reader has to open the section, as long tables are for few"""


def make_page(title: str, answer: str, sections: Sequence[Section]) -> str:
    """Return a page as HTML without scripts, which contains its pictures.

    Args:
        title: title of the page.
        answer: answer to the question that the page is about, in a sentence or two.
        sections: sections in the order in which they are read.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__, "."), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("page.html").render(
        title=title, answer=answer, sections=sections, versions=format_versions(versions())
    )


def claim_output(directory: Path, page: str, tables: Sequence[str] = ()) -> None:
    """Create the folder of an output, or check that it contains an earlier output at most.

    Args:
        directory: the folder.
        page: name of the page.
        tables: names of the CSV files.

    Raises:
        ConfigurationError: if the folder contains anything else.
    """
    claim_directory(directory, lambda name: name in (page, FIGURES, *tables))


def write_output(
    directory: Path, page: str, html: str, figures: Sequence[Figure] = (),
    tables: Mapping[str, str] | None = None,
) -> Path:
    """Write a page, its figures (SVG and PNG) and its tables (CSV), in place of earlier ones.

    Args:
        directory: folder that :func:`claim_output` has checked.
        page: name of the page.
        html: text of the page.
        figures: figures of the page.
        tables: text of each CSV file, by name.

    Returns:
        The path of the page.
    """
    drawn = directory / FIGURES
    drawn.mkdir(parents=True, exist_ok=True)
    for file in (*drawn.glob("*.svg"), *drawn.glob("*.png")):
        file.unlink()
    for figure in figures:
        figure.save(drawn)
    for name, text in {page: html, **(tables or {})}.items():
        with add_path_to_errors(directory / name):
            (directory / name).write_text(text, encoding="utf-8")
    return directory / page
