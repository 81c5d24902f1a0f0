"""What a run reports at its end: ``summary.json`` and the table on the screen."""

from __future__ import annotations

import functools
import hashlib
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from greenroof_ros import __version__
from greenroof_ros.forecast_models import PERFECT
from greenroof_ros.imperfections import Imperfections
from greenroof_ros.metrics import Metrics
from greenroof_ros.run import Run


def build(
    run: Run,
    metrics: Metrics | Mapping[str, Any],
    *,
    wall_s: float,
    solver: Mapping[str, float] | None,
    messages: Mapping[str, int] | None = None,
    refused: Mapping[str, int] | None = None,
    incidents: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Put a run's summary together, the same for ``simulate`` and the graph.

    Args:
        run: what was asked for.
        metrics: what came of it.
        wall_s: duration in wall time (s).
        solver: the controller's statistics; None where it has no solver.
        messages: how many messages of each topic are in the bag.
        refused: how many values of each topic were refused.
        incidents: parameters changed during the run, with their tick.
    """
    sums = asdict(metrics) if isinstance(metrics, Metrics) else dict(metrics)
    repeats_from = run.forecast.repeats_from
    choice = run.forecast_choice
    return {
        "controller": run.controller,
        # JSON has no infinity: null stands for "no bound".
        "parameters": {
            key: value if math.isfinite(value) else None for key, value in run.parameters.items()
        },
        "initial": {"name": run.initial, "cistern_m3": run.x1, "roof_m3": run.x2},
        "start": run.start.isoformat(),
        "steps": run.steps,
        "tau_s": run.site.tau,
        "site": str(run.site_file),
        "weather": str(run.weather.file),
        "evapotranspiration_variant": run.weather.variant,
        "forecast": {
            "model": choice.model,
            **choice.options(),
            **({"file": str(choice.file)} if choice.file is not None else {}),
        },
        "forecast_repeats_last_record_from": repeats_from.isoformat() if repeats_from else None,
        "imperfections": run.imperfections.values(),
        "filled": run.series.filled,
        "filled_hours": run.series.filled_hours,
        "frost_hours": run.series.frost_hours,
        "precipitation_in_frost_mm": run.series.precipitation_in_frost,
        **sums,
        "solver": dict(solver) if solver is not None else None,
        "wall_s": wall_s,
        "times_real_time": run.steps * run.site.tau / wall_s,
        "messages": dict(messages or {}),
        "refused": dict(refused or {}),
        "incidents": incidents or [],
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Return the versions of what computes a run's numbers."""
    found = {
        "greenroof_ros": __version__,
        "source": _source(),
        "python": platform.python_version(),
    }
    for package in ("numpy", "scipy", "osqp", "eto", "mcap", "rclpy"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue  # rclpy, where there is no ROS
    return found


@functools.cache
def _source() -> str:
    """Twelve digits that tell this package's code from any other; a version has many commits."""
    digest = hashlib.sha256()
    package = Path(__file__).parent
    for file in sorted(package.rglob("*.py")):
        digest.update(file.relative_to(package).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]


def write(summary: Mapping[str, Any], path: Path) -> None:
    """Write a summary as JSON."""
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")


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
            f"m3 ({summary['evapotranspiration_variant']})",
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
    for incident in summary["incidents"]:
        rows.append(("changed", f"tick {incident['tick']}", str(incident)))
    if summary["frost_hours"]:
        rows.append(
            (
                "FROST",
                f"{summary['frost_hours']:.1f} h",
                "at or below 0 degC, nothing pumped; "
                f"{summary['precipitation_in_frost_mm']:.1f} mm of snow or rain taken as rain",
            )
        )
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
    if not Imperfections(**summary["imperfections"]).none:
        rows.append(
            (
                "imperfections", "",
                ", ".join(f"{key} {value:g}" for key, value in summary["imperfections"].items()),
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
