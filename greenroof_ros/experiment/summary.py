"""What a run reports at its end: ``summary.json``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from greenroof_ros.common.versions import versions
from greenroof_ros.experiment.run import Run


def build(
    run: Run,
    metrics: Mapping[str, float],
    *,
    wall_s: float,
    solver: Mapping[str, float] | None,
    messages: Mapping[str, int] | None = None,
    refused: Mapping[str, int] | None = None,
    parameter_changes: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Put a run's summary together, the same for ``simulate`` and the graph.

    Args:
        run: what was asked for.
        metrics: its results, by :data:`greenroof_ros.model.metrics.METRICS`.
        wall_s: duration in wall time (s).
        solver: the controller's statistics; None where it has no solver.
        messages: how many messages of each topic are in the bag.
        refused: how many values of each topic were refused.
        parameter_changes: parameters changed during the run, with their tick.
    """
    repeats_from = run.forecast.repeats_from
    choice = run.forecast_choice
    return {
        "controller": run.controller.name,
        "controller_reference": run.controller.reference,
        # JSON has no infinity: null stands for "no bound".
        "parameters": {
            key: value if math.isfinite(value) else None for key, value in run.parameters.items()
        },
        "initial": {"name": run.initial, "cistern_m3": run.x1, "roof_m3": run.x2},
        "start": run.start.isoformat(),
        "steps": run.steps,
        "tau_s": run.site.tau,
        "site": str(run.site_file),
        "weather": run.weather.source,
        "weather_notes": list(run.weather.records.notes),
        "evapotranspiration_method": run.weather.method,
        "forecast": {
            "model": choice.model,
            **choice.options(),
            **({"file": str(choice.file)} if choice.file is not None else {}),
        },
        "forecast_repeats_last_record_from": repeats_from.isoformat() if repeats_from else None,
        "sensor_pump_errors": run.sensor_pump_errors.values(),
        "filled": run.series.filled,
        "filled_hours": run.series.filled_hours,
        "frost_hours": run.series.frost_hours,
        "precipitation_in_frost_mm": run.series.precipitation_in_frost,
        **metrics,
        "solver": dict(solver) if solver is not None else None,
        "wall_s": wall_s,
        "times_real_time": run.steps * run.site.tau / wall_s,
        "messages": dict(messages or {}),
        "refused": dict(refused or {}),
        "parameter_changes": parameter_changes or [],
        "versions": versions(),
    }


def write(summary: Mapping[str, Any], path: Path) -> None:
    """Write a summary as JSON."""
    path.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
