"""The figures of the same season in several years, and of cisterns of several sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import altair as alt

from greenroof_ros.recording.results_table import differing
from greenroof_ros.report.drawing import (
    COLOURS,
    Figure,
    Panel,
    Rows,
    cycle,
    distinct,
    pointed,
    short,
)
from greenroof_ros.report.results import Report
from greenroof_ros.report.seasons import (
    Place,
    Seasons,
    comparisons,
    given_errors,
    plain_onoff,
    seasons,
)
from greenroof_ros.report.settings import controller_name
from greenroof_ros.report.sizing import is_sizing, size_of

SEASON_FIGURES = ("seasons", "season-comparisons", "sizing")
"""the names of these figures begin with them"""

_HEIGHT = 260


def season_figures(report: Report) -> list[Callable[[], Figure]]:
    """Return what makes each figure that the seasons of a report give rise to."""
    found = seasons(report)
    if is_sizing(found):
        return [partial(sizing, found)]
    makers: list[Callable[[], Figure]] = [partial(by_year, found)]
    if any(True for _ in comparisons(found, plain_onoff(found))):
        makers.append(partial(comparison_figure, report, found))
    return makers


def _title(place: Place, found: Sequence[Seasons]) -> str:
    """Return what distinguishes a panel's place from the others."""
    apart = differing([one.place.facts for one in found])
    return ", ".join(place.facts[name] for name in apart) or "all years"


def _series(one: Seasons, found: Sequence[Seasons], *, forecast: bool = True) -> str:
    """Name a controller, with its setting and its forecasts where there are others."""
    own = [other for other in found if other.controller == one.controller]
    name = controller_name(one.controller)
    if len({other.setting for other in own}) > 1:
        name += f" {one.setting}"
    if forecast and len({other.forecast for other in own}) > 1:
        name += f", {one.forecast}"
    return name


def _scale(values: str) -> dict[str, Any]:
    """Return a quantitative axis that does not begin at 0."""
    return {"field": values, "type": "quantitative", "scale": alt.Scale(zero=False)}


def by_year(found: Sequence[Seasons]) -> Figure:
    """Return the deviation of each year: a panel for each place and kind of forecasts."""
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    looking = given_errors(found)
    usual = list(dict.fromkeys(one.forecast for one in found if one.controller in looking))
    for place in dict.fromkeys(one.place for one in found):
        here = [one for one in found if one.place == place]
        for forecast in usual or [""]:
            shown = [
                one for one in here if one.controller not in looking or one.forecast == forecast
            ]
            name = f"seasons-{len(data) + 1}"
            data[name] = _rows_by_year(shown)
            series = list(dict.fromkeys(row["series"] for row in data[name]))
            chart = alt.Chart(alt.NamedData(name)).mark_line(point=True).encode(
                x=alt.X("year:O", title=None, axis=alt.Axis(labelAngle=0)),
                y=alt.Y(**_scale("v"), title="total |x2 - x2*| of the season (m³)"),
                **distinct("series", series, ""),
                tooltip=pointed("series:N", "year:O", "v:Q", "least:Q", "largest:Q"),
            )
            title = [_title(place, found), *([f"forecasts: {forecast}"] if forecast else [])]
            panels.append(Panel(chart, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "seasons", "Deviation of each season",
        "Total deviation of each season, the mean over the seeds of the forecasts' errors. The "
        "axes do not begin at 0.", tuple(panels), max(1, min(len(usual), 3)), data,
    )


def _rows_by_year(shown: Sequence[Seasons]) -> Rows:
    return [
        {
            "series": _series(one, shown), "year": year, "v": short(float(one.totals(year).mean())),
            "least": short(float(one.totals(year).min())),
            "largest": short(float(one.totals(year).max())),
        }
        for one in shown for year in one.years
    ]


def comparison_figure(report: Report, found: Sequence[Seasons]) -> Figure:
    """Return the deviations over that of on/off with their intervals, a panel for each place."""
    less = list(comparisons(found, plain_onoff(found)))
    colours = dict(zip(report.controllers, cycle(COLOURS, report.controllers), strict=True))
    panels: list[Panel] = []
    data: dict[str, Rows] = {}
    for place in dict.fromkeys(one.of.place for one in less):
        name = f"season-comparisons-{len(data) + 1}"
        data[name] = [
            {
                "series": _series(one.of, found), "controller": controller_name(one.of.controller),
                "v": short(one.mean.value), "low": short(one.mean.low),
                "high": short(one.mean.high), "verdict": one.mean.verdict,
            }
            for one in less if one.of.place == place
        ]
        order = [str(row["series"]) for row in data[name]]
        base = alt.Chart(alt.NamedData(name)).encode(
            y=alt.Y("series:N", sort=order, title=None, axis=alt.Axis(labelLimit=400)),
            color=alt.Color("controller:N", title=None, scale=alt.Scale(
                domain=[controller_name(each) for each in colours], range=list(colours.values()),
            )),
            tooltip=pointed("series:N", "v:Q", "low:Q", "high:Q", "verdict:N"),
        )
        intervals = base.mark_rule(strokeWidth=2).encode(
            x=alt.X(**_scale("low"), title="deviation of a season over that of on/off (1)"),
            x2=alt.X2("high:Q"),
        )
        marks = base.mark_point(filled=True, size=70, opacity=1).encode(x=alt.X("v:Q"))
        line = alt.Chart(alt.InlineData(values=[{"x": 1}])).mark_rule().encode(x=alt.X("x:Q"))
        panels.append(
            Panel(alt.layer(line, intervals, marks), _title(place, found), height=_HEIGHT)
        )
    return Figure(
        "season-comparisons", "Deviation over that of on/off",
        "Total deviation of all seasons over that of on/off in the same ones, and its 95 % "
        "interval. An interval across the line at 1 may be luck.", tuple(panels), 1, data,
    )


def sizing(found: Sequence[Seasons]) -> Figure:
    """Return water saved over the cistern's volume, and overflow over it, for each roof area."""
    data: dict[str, Rows] = {}
    upper, lower = [], []
    series = list(dict.fromkeys(_series(one, found) for one in found))
    for area in sorted({size_of(one.site).roof_m2 for one in found}):
        name = f"sizing-{len(data) + 1}"
        here = [one for one in found if size_of(one.site).roof_m2 == area]
        data[name] = [
            {
                "series": _series(one, found), "volume": short(size_of(one.site).cistern_m3),
                "saved": short(one.mean("saved_m3")), "overflow": short(one.mean("outflow_m3")),
            }
            for one in sorted(here, key=lambda one: size_of(one.site).cistern_m3)
        ]
        base = alt.Chart(alt.NamedData(name)).encode(
            **distinct("series", series, ""),
            tooltip=pointed("series:N", "volume:Q", "saved:Q", "overflow:Q"),
        )
        title = f"green roof of {area:g} m²"
        volumes = sorted({row["volume"] for row in data[name]})
        saved = base.mark_line(point=True).encode(
            x=alt.X("volume:Q", title="cistern up to its outlet (m³)",
                    axis=alt.Axis(values=volumes), scale=alt.Scale(type="log", nice=False)),
            y=alt.Y("saved:Q", title="mains water saved (m³ a season)"),
        )
        traded = base.mark_line(point=True).encode(
            x=alt.X(**_scale("overflow"), title="overflow to the sewer (m³ a season)"),
            y=alt.Y(**_scale("saved"), title="mains water saved (m³ a season)"),
            order=alt.Order("volume:Q"),
        )
        upper.append(Panel(saved, title, height=_HEIGHT, toggle="series"))
        lower.append(Panel(traded, title, height=_HEIGHT, toggle="series"))
    return Figure(
        "sizing", "Cistern and green roof: mains water saved and overflow",
        "Means of a season. Above: over the volume of the cistern. Below: the trade-off, each mark "
        "a cistern, the smallest at the right. The axes below do not begin at 0.",
        (*upper, *lower), len(upper), data,
    )
