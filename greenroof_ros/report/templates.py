"""The templates of pages, which share one base: its head, its style, and how figures are drawn."""

from __future__ import annotations

import jinja2


def environment(package: str) -> jinja2.Environment:
    """Return what fills in a package's templates; ``base.html`` of this one is there for all.

    A value that a template uses and is not given is an error.
    """
    places = [jinja2.PackageLoader(name, ".") for name in (package, __package__)]
    return jinja2.Environment(
        loader=jinja2.ChoiceLoader(places), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
