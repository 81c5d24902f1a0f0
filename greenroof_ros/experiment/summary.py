"""What a run reports of itself: ``summary.json``, from its start on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from greenroof_ros.common.versions import versions
from greenroof_ros.experiment.run import Run

# The file's name in the directory of a run.
SUMMARY = "summary.json"
# How a run ended. It is RUNNING until then, and for ever if what runs it was killed.
RUNNING, DONE, FAILED, INTERRUPTED = "running", "done", "failed", "interrupted"


def build(
    run: Run,
    metrics: Mapping[str, float],
    weeks: Sequence[float],
    *,
    wall_s: float,
    solver: Mapping[str, float] | None,
    messages: Mapping[str, int] | None = None,
    **happened: Any,
) -> dict[str, Any]:
    """Put the summary of a run that is done together, the same for ``simulate`` and the graph.

    Args:
        run: what was asked for.
        metrics: its results, by :data:`greenroof_ros.model.metrics.METRICS`.
        weeks: total deviation of each week (m3).
        wall_s: duration in wall time (s).
        solver: the controller's statistics; None where it has no solver.
        messages: how many messages of each topic are in the bag.
        happened: refused, parameter_changes and incidents, as :func:`build_unfinished` has them.
    """
    return {
        **build_unfinished(run, DONE, last_tick=run.steps, **happened),
        "frost_hours": run.series.frost_hours,
        "precipitation_in_frost_mm": run.series.precipitation_in_frost,
        **metrics,
        "weekly_deviation_m3": list(weeks),
        "solver": dict(solver) if solver is not None else None,
        "wall_s": wall_s,
        "times_real_time": run.steps * run.site.tau / wall_s,
        "messages": dict(messages or {}),
    }


def build_unfinished(
    run: Run,
    status: str,
    *,
    reason: str | None = None,
    last_tick: int | None = None,
    refused: Mapping[str, int] | None = None,
    parameter_changes: list[dict[str, Any]] | None = None,
    incidents: list[dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Put the summary of a run that is not done together: without metrics, which are of whole runs.

    Args:
        run: what was asked for.
        status: one of those above.
        reason: why it ended.
        last_tick: the last that the plant reported.
        refused: how many values of each topic were refused until then.
        parameter_changes: parameters changed until then, with their tick.
        incidents: what was lost in the run while it went on.
    """
    repeats_from = run.forecast.repeats_from
    choice = run.forecast_choice
    layer = {} if run.site.drainage_storage is None else {"layer_m3": run.site.initial_layer}
    return {
        "status": status,
        "reason": reason,
        "last_tick": last_tick,
        "controller": run.controller.name,
        "controller_reference": run.controller.reference,
        "parameters": finite(run.parameters),
        "initial": {"name": run.initial, "cistern_m3": run.x1, "roof_m3": run.x2, **layer},
        "start": run.start.isoformat(),
        "steps": run.steps,
        "tau_s": run.site.tau,
        "site": str(run.site_file),
        "weather": run.weather.source,
        "weather_notes": list(run.weather.notes),
        "gaps": run.weather.gaps,
        "evapotranspiration_method": run.weather.method,
        "forecast": {
            "model": choice.model,
            **choice.options(),
            **({"file": str(choice.file)} if choice.file is not None else {}),
            **({"dressed": str(choice.dressed)} if choice.dressed is not None else {}),
        },
        "forecast_repeats_last_record_from": repeats_from.isoformat() if repeats_from else None,
        "sensor_pump_errors": run.sensor_pump_errors.values(),
        "filled": run.series.filled,
        "filled_hours": run.series.filled_hours,
        "suspicious": run.series.suspicious,
        "refused": dict(refused or {}),
        "parameter_changes": parameter_changes or [],
        "incidents": incidents or [],
        "versions": versions(),
    }


def finite(parameters: Mapping[str, float]) -> dict[str, float | None]:
    """Return parameters as JSON has them, which has no infinity: null stands for no bound."""
    return {name: value if math.isfinite(value) else None for name, value in parameters.items()}


def write(summary: Mapping[str, Any], directory: Path) -> None:
    """Write a summary into the directory of its run, whole or not at all.

    A disk that is full has no room for a second file beside the old one, but for what is written
    over it: there a run must be able to say that it ended.

    Raises:
        OSError: it cannot be written.
    """
    path = directory / SUMMARY
    part = directory / f".{SUMMARY}.part"
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        try:
            with path.open("r+", encoding="utf-8") as stream:
                stream.write(text)
                stream.truncate()
        except OSError:
            # The error of a write does not know its file.
            raise OSError(error.errno, error.strerror, str(path)) from error


def site_file_of(run: Path) -> Path:
    """Return where a run keeps its site file; a live site, in a directory of its own."""
    configuration = run / "configuration"
    return next(iter((configuration / "site").glob("*")), configuration / "site.yaml")
