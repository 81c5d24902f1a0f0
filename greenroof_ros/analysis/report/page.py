"""The page of a report: a self-contained HTML file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import jinja2
import vl_convert
from markupsafe import Markup

from greenroof_ros.analysis.figures import CONFIG, Figure, Rows
from greenroof_ros.results.versions import format_versions, versions


def make_page(package: str, figures: Sequence[Figure], **values: object) -> str:
    """Render a package's ``page.html``, which can extend this package's templates.

    It is an error if a value that a template uses is missing.

    Args:
        package: name of the package.
        figures: figures in the order in which they appear.
        values: other values for the template.
    """
    places = [jinja2.PackageLoader(name, ".") for name in (package, __package__)]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(places), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template("page.html").render({
        "figures": figures, "versions": format_versions(versions()), "library": _library(),
        "payload": payload(figures), "folded": False, **values,
    })


# Scripts and JSON are not HTML: each is escaped here in its own way.


def _library() -> Markup:
    """Return the scripts that draw a page's figures."""
    text: str = vl_convert.javascript_bundle()  # type: ignore[call-arg]  # its stub is stricter
    return Markup(text.replace("</script", "<\\/script"))  # noqa: S704


def payload(figures: Sequence[Figure]) -> Markup:
    """Return the figures of a page, with their data, as JSON."""
    panels = [
        {
            "id": f"{figure.name}-panel-{number}", "figure": figure.name,
            "specification": panel.sized("container").to_dict(),
        }
        for figure in figures for number, panel in enumerate(figure.panels, start=1)
    ]
    data = {
        figure.name: {name: _columns(rows) for name, rows in figure.data.items()}
        for figure in figures
    }
    text = json.dumps(
        {"config": CONFIG, "panels": panels, "data": data},
        allow_nan=False, separators=(",", ":"), ensure_ascii=False,
    )
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _columns(rows: Rows) -> dict[str, list[Any]]:
    """Return rows as columns, so that every name is written only once."""
    return {name: [row[name] for row in rows] for name in (rows[0] if rows else {})}
