"""The summary of a run, shown as a table on the screen."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from rich.table import Table

from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.text import escape
from greenroof_ros.base.times import to_minutes
from greenroof_ros.controllers.outlet import PLAN
from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.physics.pump import SensorAndPump
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.site.site import format_place
from greenroof_ros.weather.summary import as_lines

# Peaks that are only in files: the shortest one is enough here.
_IN_FILES = ("15min_l_s", "60min_l_s", "min_mm_h")


def _metric_rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield the metrics, without those that are 0 as expected, and the number of rain events.

    Capitals mark values over a limit.
    """
    for metric in METRICS:
        value = summary.get(metric.name)
        if value is not None and (value or metric.max) and not metric.name.endswith(_IN_FILES):
            label = metric.label.upper() if value > metric.max else metric.label
            yield label, f"{value:{metric.form}}", metric.description
    if events := summary.get("events"):
        largest = max(events, key=lambda event: float(event["rain_mm"]))
        yield "rain events", str(len(events)), (
            f"the largest: {largest['rain_mm']:.1f} mm, with {largest['volume_reduction']:.0%} of "
            f"its volume and {largest['peak_reduction']:.0%} of its peak kept out of the sewer"
        )


def grid(title: str, lines: Iterable[tuple[str, str, str]]) -> Table:
    """Return a table in which every row is a label, a number and a description."""
    table = Table(title=title, title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(justify="right")
    table.add_column()
    for line in lines:
        table.add_row(*line)
    return table


def rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield the rows of the table at the end of a run: a label, a number and a description."""
    yield from setting_rows(summary)
    yield "controller", summary["controller"], _listed(summary["parameters"])
    yield from _metric_rows(summary)
    if solver := summary["solver"]:
        yield "solver", f"{solver['mean_s'] * 1e6:.0f} us", (
            f"mean; p99 {solver['p99_s'] * 1e6:.0f} us; {solver['solves']} solves, "
            f"{solver['fallbacks']} fallbacks"
        )
    if refused := summary["refused"]:
        topics = ", ".join(f"{count} on {topic}" for topic, count in refused.items())
        yield "REFUSED", str(sum(refused.values())), f"values: {topics}"
    if left_out := summary["parameter_change_count"] - len(summary["parameter_changes"]):
        yield "CHANGED", f"{left_out} times", "before the latest changes, which are listed below"
    for change in summary["parameter_changes"]:
        before, value = (
            "no limit" if number is None else f"{number:g}"
            for number in (change["before"], change["value"])
        )
        yield "CHANGED", change["parameter"], f"{before} -> {value} in tick {change['tick']}"
    if summary["frost_hours"]:
        yield "FROST", f"{summary['frost_hours']:.1f} h", (
            f"at or below 0 degC, without pumping; {summary['precipitation_in_frost_mm']:.1f} mm "
            "of precipitation, treated as rain"
        )
    forecast = dict(summary["forecast"])
    model = forecast.pop("model")
    used = summary["controller"] != "onoff" or summary["parameters"].get("outlet") == PLAN
    if used or model != PERFECT:
        yield "forecast", model, _listed(forecast) or "the weather of the run itself"
    if SensorAndPump(**summary["sensor_and_pump"]) != SensorAndPump():
        yield "sensor and pump", "", _listed(summary["sensor_and_pump"])
    factor = f"{summary['times_real_time']:.0f} times real time"
    yield "wall time", f"{summary['wall_s']:.1f} s", factor


def setting_rows(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield rows about a run's site, weather, initial state and length."""
    start = datetime.fromisoformat(summary["start"])
    end = start + timedelta(seconds=summary["steps"] * summary["tau_s"])
    places = [format_place(*place) for place in summary["weather_places"]]
    first, last = (
        to_minutes(datetime.fromisoformat(summary[f"weather_{at}"])) for at in ("from", "until")
    )
    volumes = dict(summary["initial"])
    name = volumes.pop("name")
    yield "site", Path(summary["site"]).name, format_place(*summary["place"])
    yield "weather", Path(summary["weather"]).name, (
        f"{' and '.join(places) or format_place(None, None)}; records from {first} to {last}, the "
        f"run from {to_minutes(start)} to {to_minutes(end)}"
    )
    for note in summary["weather_notes"]:
        yield "weather", "note", note
    stores = " / ".join(volume.removesuffix("_m3") for volume in volumes)
    yield "from", " / ".join(map("{:.3f}".format, volumes.values())), f"m3 in {stores} ({name})"
    yield (
        "length", f"{summary['steps']} ticks",
        f"of {summary['tau_s']:g} s, {summary['evapotranspiration_method']} evapotranspiration",
    )


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in values.items() if value is not None
    )


def show(
    title: str, lines: Iterable[tuple[str, str, str]], result: Mapping[str, Any], *, as_json: bool,
    end: str = "",
) -> None:
    """Print a result as a table, after the notes that a reader should see first, or as JSON.

    Args:
        title: title of the table.
        lines: rows of the table, as for :func:`grid`.
        result: the result with its ``notes``.
        as_json: whether to print the result as JSON.
        end: a sentence after the table.
    """
    if as_json:
        print(json.dumps(result, indent=2, allow_nan=False))
        return
    console = PlainConsole()
    for note in result["notes"]:
        console.print(f"note: {note}", soft_wrap=True)
    console.print(grid(title, lines))
    if end:
        console.print(end, soft_wrap=True)


def print_weather(summary: Mapping[str, Any], name: str = "weather") -> None:
    """Print what a weather record contains to standard error, before a run.

    Args:
        summary: the record's summary; see :func:`greenroof_ros.weather.summary.summarize`.
        name: name of the record.
    """
    for line in as_lines(summary):
        print(escape(f"{name}: {line}"), file=sys.stderr)


def show_summary(summary: Mapping[str, Any], directory: Path, *, as_json: bool) -> None:
    """Print a summary as a table, with the run's directory, or as JSON."""
    end = f"{summary['status']}; written to {directory}"
    show("Result", rows(summary), summary, as_json=as_json, end=end)
