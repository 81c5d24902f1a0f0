"""The page of a verification: one file with all figures that needs nothing but a browser."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import altair as alt

from greenroof_ros.common.quality import Finding
from greenroof_ros.common.versions import versions, versions_text
from greenroof_ros.report.drawing import Figure, Panel, Rows, distinct, hover_points, pointed, short
from greenroof_ros.report.page import environment, library, payload
from greenroof_ros.verification.issued import IssuedForecasts
from greenroof_ros.verification.pairs import Class, Sum
from greenroof_ros.verification.scores import SHOWN, TENTHS, Tally

# Name in Scores, title of its panel, and of its axis.
_BY_LEAD = (
    ("r", "Correlation", "r"),
    ("ets", "Events: equitable threat score", "ETS"),
    ("pod", "Events that were forecast", "POD"),
    ("far", "Forecast events that did not come", "FAR"),
    ("bias", "Water: forecast over observed", "bias"),
    ("crps", "Error: CRPS", "CRPS (mm)"),
)
# Lines of leads in one panel, at most.
_MOST_LEADS = 5


def render(
    forecasts: IssuedForecasts, records: str, tallies: Mapping[Class, Tally],
    findings: Sequence[Finding],
) -> str:
    """Return the page.

    Args:
        forecasts: which.
        records: that they are compared with, in words.
        tallies: what adds up in each class.
        findings: what is most likely wrong with them.
    """
    figures = [_by_lead(tallies)]
    if forecasts.members > 1:
        figures += [_reliability(tallies), _ranks(tallies)]
    return environment(__package__).get_template("page.html").render(
        forecasts=forecasts, records=records, findings=findings, shown=SHOWN, figures=figures,
        rows=[(one, tally.scores()) for one, tally in tallies.items()],
        versions=versions_text(versions()), library=library(), payload=payload(figures),
    )


def _by_lead(tallies: Mapping[Class, Tally]) -> Figure:
    scores = {one: tally.scores() for one, tally in tallies.items()}
    names = list(dict.fromkeys(_sum_name(one.sum) for one in tallies))
    leads = list(dict.fromkeys(one.lead for one in tallies))
    data: dict[str, Rows] = {}
    panels = []
    for name, title, axis in _BY_LEAD:
        data[f"verification-{name}"] = [
            {"lead": one.lead, "sum": _sum_name(one.sum), "v": short(getattr(values, name))}
            for one, values in scores.items() if not math.isnan(getattr(values, name))
        ]
        panels.append(_lines(f"verification-{name}", title, axis, leads, names))
    events = ", ".join(
        dict.fromkeys(f"{one.sum.event:g} mm in {one.sum.hours} h" for one in tallies)
    )
    caption = (
        f"By lead, a line for each length of sums. Events are those of at least {events}. A "
        "perfect forecast has r, ETS, POD and bias 1, FAR and CRPS 0."
    )
    return Figure("verification-leads", "Scores by lead", caption, tuple(panels), 2, data)


def _sum_name(one: Sum) -> str:
    return f"{one.hours} h"


def _lines(data: str, title: str, axis: str, leads: list[str], names: list[str]) -> Panel:
    lines = alt.Chart(alt.NamedData(data)).mark_line(point=True, strokeWidth=1.5).encode(
        x=alt.X("lead:N", title="lead", sort=leads, axis=alt.Axis(labelAngle=0)),
        y=alt.Y("v:Q", title=axis),
        tooltip=pointed("lead:N", "sum:N", alt.Tooltip("v:Q", title=axis, format=".3f")),
        **distinct("sum", names, "sum of"),
    )
    return Panel(lines, title, hover=hover_points(lines), toggle="sum")


def _of_sums(tallies: Mapping[Class, Tally]) -> dict[Sum, list[tuple[str, Tally]]]:
    """Return the leads of each sum that are drawn, spread evenly, and what adds up in them."""
    found: dict[Sum, list[tuple[str, Tally]]] = {}
    for one, tally in tallies.items():
        found.setdefault(one.sum, []).append((one.lead, tally))
    return {one: _spread(leads) for one, leads in found.items()}


def _spread(leads: Sequence[tuple[str, Tally]]) -> list[tuple[str, Tally]]:
    if len(leads) <= _MOST_LEADS:
        return list(leads)
    last = len(leads) - 1
    return [leads[round(number * last / (_MOST_LEADS - 1))] for number in range(_MOST_LEADS)]


def _reliability(tallies: Mapping[Class, Tally]) -> Figure:
    data: dict[str, Rows] = {}
    panels = []
    for one, leads in _of_sums(tallies).items():
        name = f"verification-reliability-{one.hours}"
        data[name] = [
            {"lead": lead, "p": short(total / count), "o": short(events / count), "n": int(count)}
            for lead, tally in leads
            for count, total, events in tally.reliability.tolist() if count
        ]
        panels.append(_diagram(name, one, [lead for lead, _ in leads]))
    caption = (
        f"How often the event came, by the probability that was forecast, in {TENTHS} steps: of a "
        "reliable ensemble as often as forecast, on the grey line. Below it the event is "
        "forecast too often. The pointer shows how many forecasts a point stands for."
    )
    return Figure("verification-reliability", "Reliability", caption, tuple(panels), 2, data)


def _diagram(data: str, one: Sum, leads: list[str]) -> Panel:
    scale = alt.Scale(domain=[0, 1])
    perfect = alt.Chart(alt.InlineData([{"v": 0}, {"v": 1}])).mark_line(
        color="#888888", strokeWidth=1
    ).encode(x=alt.X("v:Q"), y=alt.Y("v:Q"))
    lines = alt.Chart(alt.NamedData(data)).mark_line(point=True, strokeWidth=1.5).encode(
        x=alt.X("p:Q", title="probability that was forecast", scale=scale),
        y=alt.Y("o:Q", title="share of events", scale=scale),
        tooltip=pointed("lead:N", alt.Tooltip("p:Q", title="forecast", format=".2f"),
                 alt.Tooltip("o:Q", title="observed", format=".2f"),
                 alt.Tooltip("n:Q", title="forecasts")),
        **distinct("lead", leads, "lead"),
    )
    return Panel(
        alt.layer(perfect, lines), f"{one.hours} h, {one.event:g} mm and more", height=280,
        hover=hover_points(lines), toggle="lead",
    )


def _ranks(tallies: Mapping[Class, Tally]) -> Figure:
    data: dict[str, Rows] = {}
    panels = []
    for one, leads in _of_sums(tallies).items():
        name = f"verification-ranks-{one.hours}"
        data[name] = [
            {"lead": lead, "rank": rank, "v": short(count * len(tally.ranks) / tally.ranks.sum())}
            for lead, tally in leads if tally.ranks.sum()
            for rank, count in enumerate(tally.ranks.tolist())
        ]
        panels.append(_histogram(name, one, [lead for lead, _ in leads]))
    caption = (
        "How often so many members were below what was observed, over how often that would be if "
        "members and observation could be one another, the grey line. High at both ends: the "
        "ensemble is too narrow; high at the left: it forecasts too much."
    )
    return Figure("verification-ranks", "Rank histogram", caption, tuple(panels), 2, data)


def _histogram(data: str, one: Sum, leads: list[str]) -> Panel:
    even = alt.Chart(alt.InlineData([{"v": 1}])).mark_rule(color="#888888").encode(y=alt.Y("v:Q"))
    steps = alt.Chart(alt.NamedData(data)).mark_line(
        interpolate="step", strokeWidth=1.5
    ).encode(
        x=alt.X("rank:Q", title="members below the observation", axis=alt.Axis(tickMinStep=1)),
        y=alt.Y("v:Q", title="over an even share", scale=alt.Scale(zero=True)),
        tooltip=pointed("lead:N", "rank:Q", alt.Tooltip("v:Q", title="over even", format=".2f")),
        **distinct("lead", leads, "lead"),
    )
    return Panel(
        alt.layer(even, steps), f"Sums of {one.hours} h", hover=hover_points(steps), toggle="lead"
    )
