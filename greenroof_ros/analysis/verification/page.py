"""The page of a verification: one file with all figures that needs only a browser."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import altair as alt

from greenroof_ros.analysis.report.drawing import (
    Figure,
    Rows,
    make_tooltips,
    round_value,
    series_panel,
)
from greenroof_ros.analysis.report.page import page_of
from greenroof_ros.analysis.verification.pairs import Class, IssuedForecasts
from greenroof_ros.analysis.verification.scores import SHOWN, Tally

# Name in Scores, title of the panel, and title of its axis.
_BY_LEAD = (
    ("r", "Correlation", "r"),
    ("ets", "Events: equitable threat score", "ETS"),
    ("pod", "Events that were forecast", "POD"),
    ("far", "Forecast events that did not occur", "FAR"),
    ("bias", "Water: forecast over observed", "bias"),
    ("crps", "Error: CRPS", "CRPS (mm)"),
)


def render(
    forecasts: IssuedForecasts, records: str, tallies: Mapping[Class, Tally],
    warnings: Sequence[str],
) -> str:
    """Return the page.

    Args:
        forecasts: the forecasts that were verified.
        records: name of the records that they were compared with.
        tallies: the tally of each class.
        warnings: what is most likely wrong with the forecasts.
    """
    return page_of(
        __package__, [_draw_scores(tallies)], forecasts=forecasts, records=records,
        warnings=warnings, shown=SHOWN,
        rows=[(key, tally.scores()) for key, tally in tallies.items()],
    )


def _draw_scores(tallies: Mapping[Class, Tally]) -> Figure:
    scores = {key: tally.scores() for key, tally in tallies.items()}
    names = list(dict.fromkeys(f"{key.sum.hours} h" for key in tallies))
    leads = list(dict.fromkeys(key.lead for key in tallies))
    data: dict[str, Rows] = {}
    panels = []
    for name, title, axis in _BY_LEAD:
        data[f"verification-{name}"] = [
            {"lead": key.lead, "sum": f"{key.sum.hours} h", "v": round_value(getattr(values, name))}
            for key, values in scores.items() if not math.isnan(getattr(values, name))
        ]
        base = alt.Chart(alt.NamedData(f"verification-{name}"))
        lines = base.mark_line(point=True, strokeWidth=1.5).encode(
            x=alt.X("lead:N", title="lead", sort=leads, axis=alt.Axis(labelAngle=0)),
            y=alt.Y("v:Q", title=axis),
            tooltip=make_tooltips("lead:N", "sum:N", alt.Tooltip("v:Q", title=axis, format=".3f")),
        )
        panels.append(series_panel(lines, "sum", names, title, legend="sum of"))
    events = ", ".join(
        dict.fromkeys(f"{key.sum.event:g} mm in {key.sum.hours} h" for key in tallies)
    )
    caption = (
        f"By lead, one line for each length of sums. An event has at least {events}. A "
        "perfect forecast has r, ETS, POD and bias 1, and FAR and CRPS 0."
    )
    return Figure("verification-leads", "Scores by lead", caption, tuple(panels), 2, data)
