"""The page of a verification: one file with all figures that needs only a browser."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import altair as alt
import numpy as np

from greenroof_ros.analysis.report.drawing import (
    Figure,
    Panel,
    Rows,
    make_tooltips,
    round_value,
    series_panel,
)
from greenroof_ros.analysis.report.page import page_of
from greenroof_ros.analysis.verification.pairs import Class, IssuedForecasts, Sum
from greenroof_ros.analysis.verification.scores import SHOWN, TENTHS, Tally

# Name in Scores, title of the panel, and title of its axis.
_BY_LEAD = (
    ("r", "Correlation", "r"),
    ("ets", "Events: equitable threat score", "ETS"),
    ("pod", "Events that were forecast", "POD"),
    ("far", "Forecast events that did not occur", "FAR"),
    ("bias", "Water: forecast over observed", "bias"),
    ("crps", "Error: CRPS", "CRPS (mm)"),
)
# Most lines (leads) in one panel.
_MOST_LEADS = 5


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
    figures = [_by_lead(tallies)]
    if forecasts.members > 1:
        figures += [_reliability(tallies), _ranks(tallies)]
    return page_of(
        __package__, figures, forecasts=forecasts, records=records, warnings=warnings, shown=SHOWN,
        rows=[(key, tally.scores()) for key, tally in tallies.items()],
    )


def _by_lead(tallies: Mapping[Class, Tally]) -> Figure:
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


def _reliability(tallies: Mapping[Class, Tally]) -> Figure:
    scale = alt.Scale(domain=[0, 1])
    perfect = alt.Chart(alt.InlineData([{"v": 0}, {"v": 1}])).mark_line(
        color="#888888", strokeWidth=1
    ).encode(x=alt.X("v:Q"), y=alt.Y("v:Q"))

    def rows(tally: Tally) -> Rows:
        return [
            {"p": round_value(total / count), "o": round_value(events / count), "n": int(count)}
            for count, total, events in tally.reliability.tolist() if count
        ]

    def panel(data: alt.Chart, length: Sum, leads: list[str]) -> Panel:
        lines = data.mark_line(point=True, strokeWidth=1.5).encode(
            x=alt.X("p:Q", title="forecast probability", scale=scale),
            y=alt.Y("o:Q", title="share of events", scale=scale),
            tooltip=make_tooltips("lead:N", alt.Tooltip("p:Q", title="forecast", format=".2f"),
                            alt.Tooltip("o:Q", title="observed", format=".2f"),
                            alt.Tooltip("n:Q", title="forecasts")),
        )
        return series_panel(
            lines, "lead", leads, f"{length.hours} h, {length.event:g} mm and more", legend="lead",
            below=[perfect], height=280,
        )

    caption = (
        f"Observed frequency of the event by forecast probability, in {TENTHS} steps; a reliable "
        "ensemble lies on the grey line. Below it the event is forecast too often. Point at a "
        "mark to see how many forecasts it stands for."
    )
    return _by_sum("reliability", "Reliability", caption, tallies, rows, panel)


def _ranks(tallies: Mapping[Class, Tally]) -> Figure:
    even = alt.Chart(alt.InlineData([{"v": 1}])).mark_rule(color="#888888").encode(y=alt.Y("v:Q"))

    def rows(tally: Tally) -> Rows:
        total = tally.ranks.sum()
        shares = (tally.ranks * len(tally.ranks) / total).tolist() if total else []
        return [{"rank": rank, "v": round_value(share)} for rank, share in enumerate(shares)]

    def panel(data: alt.Chart, length: Sum, leads: list[str]) -> Panel:
        steps = data.mark_line(interpolate="step", strokeWidth=1.5, point="transparent").encode(
            x=alt.X("rank:Q", title="members below the observation", axis=alt.Axis(tickMinStep=1)),
            y=alt.Y("v:Q", title="relative to an even share", scale=alt.Scale(zero=True)),
            tooltip=make_tooltips(
                "lead:N", "rank:Q", alt.Tooltip("v:Q", title="relative to even", format=".2f")
            ),
        )
        title = f"Sums of {length.hours} h"
        return series_panel(steps, "lead", leads, title, legend="lead", below=[even])

    caption = (
        "How often each number of members was below the observation, relative to interchangeable "
        "members and observation (grey line). High at both ends: the "
        "ensemble is too narrow; high at the left: it forecasts too much."
    )
    return _by_sum("ranks", "Rank histogram", caption, tallies, rows, panel)


def _by_sum(
    name: str, title: str, caption: str, tallies: Mapping[Class, Tally],
    rows: Callable[[Tally], Rows], panel: Callable[[alt.Chart, Sum, list[str]], Panel],
) -> Figure:
    """Return a figure with a panel for each length of sum, and in it lines for at most five leads.

    Args:
        name: of the figure.
        title: of the figure.
        caption: of the figure.
        tallies: the tally of each class.
        rows: returns the rows of a line, without its lead.
        panel: returns a panel from its data, its sum, and the evenly spread leads that it shows.
    """
    data: dict[str, Rows] = {}
    panels = []
    for length in dict.fromkeys(key.sum for key in tallies):
        leads = [(key.lead, tally) for key, tally in tallies.items() if key.sum == length]
        places = np.linspace(0, len(leads) - 1, _MOST_LEADS).round().astype(int)
        shown = [leads[place] for place in np.unique(places)]
        dataset = f"verification-{name}-{length.hours}"
        data[dataset] = [{"lead": lead, **row} for lead, tally in shown for row in rows(tally)]
        base = alt.Chart(alt.NamedData(dataset))
        panels.append(panel(base, length, [lead for lead, _ in shown]))
    return Figure(f"verification-{name}", title, caption, tuple(panels), 2, data)
