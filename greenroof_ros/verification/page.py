"""The page of a verification: one file that needs nothing but a browser."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greenroof_ros.common.versions import versions, versions_text
from greenroof_ros.report.page import library, payload
from greenroof_ros.report.templates import environment
from greenroof_ros.verification.figures import make_figures
from greenroof_ros.verification.pairs import Class
from greenroof_ros.verification.scores import Tally
from greenroof_ros.verification.table import SHOWN, heading, shown


def render(
    forecasts: str, records: str, count: int, tallies: Mapping[Class, Tally],
    faults: Sequence[str],
) -> str:
    """Return the page.

    Args:
        forecasts: which, in words.
        records: that they are held against, likewise.
        count: how many forecasts.
        tallies: what adds up in each class.
        faults: what is most likely wrong with them, each in a sentence without its full stop.
    """
    figures = make_figures(tallies)
    rows = []
    for one, tally in tallies.items():
        scores = tally.scores()
        rows.append((one, [shown(name, scores) for name in SHOWN]))
    return environment(__package__).get_template("page.html").render(
        forecasts=forecasts, records=records, count=count, headings=list(map(heading, SHOWN)),
        members=len(next(iter(tallies.values())).ranks) - 1, rows=rows, figures=figures,
        faults=faults, versions=versions_text(versions()), library=library(),
        payload=payload(figures),
    )
