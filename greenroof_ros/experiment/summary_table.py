"""The summary of a run as a table on the screen."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from greenroof_ros.forecast.choice import PERFECT
from greenroof_ros.model.sensor_pump_errors import SensorPumpErrors


def table(summary: Mapping[str, Any]) -> Table:
    """Return the table that a person sees at the end of a run."""
    grid = Table(title="Result", title_justify="left", show_header=False)
    grid.add_column(style="bold")
    grid.add_column(justify="right")
    grid.add_column()
    parameters = ", ".join(
        f"{key} {value:g}" for key, value in summary["parameters"].items() if value is not None
    )
    rows: list[tuple[str, str, str]] = [
        ("controller", summary["controller"], parameters),
        (
            "from",
            f"{summary['initial']['cistern_m3']:.3f} / {summary['initial']['roof_m3']:.3f}",
            f"m3 in cistern / on roof ({summary['initial']['name']})",
        ),
        (
            "to",
            f"{summary['final_cistern_m3']:.3f} / {summary['final_roof_m3']:.3f}",
            f"m3 after {summary['steps']} ticks of {summary['tau_s']:g} s",
        ),
        ("total deviation", f"{summary['total_deviation_m3']:.2f}", "m3, summed over the ticks"),
        ("pumped", f"{summary['pumped_m3']:.4f}", "m3"),
        ("pump starts", str(summary["pump_starts"]), f"{summary['energy_kwh']:.4f} kWh into water"),
        ("outflow", f"{summary['outflow_m3']:.4f}", "m3 to the sewer"),
        ("drainage", f"{summary['drainage_m3']:.4f}", "m3 off the roof"),
        ("rain", f"{summary['rain_m3']:.4f}", "m3 into both"),
        (
            "evapotranspiration",
            f"{summary['evapotranspiration_m3']:.4f}",
            f"m3 ({summary['evapotranspiration_method']})",
        ),
        ("largest command", f"{summary['max_command']:.6g}", "of the maximum flow"),
    ]
    solver = summary["solver"]
    if solver is not None:
        rows.append(
            (
                "solver",
                f"{solver['mean_s'] * 1e6:.0f} us",
                f"mean; p99 {solver['p99_s'] * 1e6:.0f} us; "
                f"{solver['solves']} solves, {solver['fallbacks']} fallbacks",
            )
        )
    if summary["limited_steps"]:
        rows.append(("LIMITED", str(summary["limited_steps"]), "ticks in which a tank ran empty"))
    if summary["refused"]:
        rows.append(("REFUSED", str(sum(summary["refused"].values())), str(summary["refused"])))
    for change in summary["parameter_changes"]:
        rows.append(("changed", f"tick {change['tick']}", str(change)))
    if summary["frost_hours"]:
        rows.append(
            (
                "FROST",
                f"{summary['frost_hours']:.1f} h",
                "at or below 0 degC, nothing pumped; "
                f"{summary['precipitation_in_frost_mm']:.1f} mm of snow or rain taken as rain",
            )
        )
    for note in summary["weather_notes"]:
        rows.append(("weather", "moved", note))
    for quantity, hours in summary["filled"].items():
        rows.append(("FILLED", quantity, ", ".join(hours)))
    forecast = dict(summary["forecast"])
    model = forecast.pop("model")
    if model != PERFECT:
        rows.append(
            ("forecast", model, ", ".join(f"{key} {value}" for key, value in forecast.items()))
        )
    repeats_from = summary["forecast_repeats_last_record_from"]
    if repeats_from:
        rows.append(
            ("forecast", "repeats", f"its last record from {repeats_from}")
        )
    if not SensorPumpErrors(**summary["sensor_pump_errors"]).none:
        rows.append(
            (
                "sensor_pump_errors", "",
                ", ".join(f"{key} {value:g}" for key, value in summary["sensor_pump_errors"].items()),
            )
        )
    if summary["messages"]:
        rows.append(
            (
                "messages",
                str(sum(summary["messages"].values())),
                f"in the bag, of {len(summary['messages'])} topics",
            )
        )
    factor = f"{summary['times_real_time']:.0f} times real time"
    rows.append(("wall time", f"{summary['wall_s']:.1f} s", factor))
    for row in rows:
        grid.add_row(*row)
    return grid


def show(summary: Mapping[str, Any], *, as_json: bool, path: Path | None) -> None:
    """Print a summary: as a table with the path of the run, or as JSON alone."""
    if as_json:
        print(json.dumps(summary, indent=2, allow_nan=False))
        return
    console = Console()
    console.print(table(summary))
    if path is not None:
        console.print(f"written to {path}", soft_wrap=True, highlight=False)
