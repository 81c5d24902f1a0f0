"""The summary of a run, ``summary.json``, which exists from the start of the run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from greenroof_ros.base.files import replace_text
from greenroof_ros.base.parameter import replace_infinity
from greenroof_ros.base.versions import versions
from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.table import EVENTS, event_rows, format_events
from greenroof_ros.simulation.run import Run

# The file's name in the directory of a run.
SUMMARY = "summary.json"
# The site file's name in the configuration of a run.
SITE_FILE = "site.yaml"
# Status of a run. It is RUNNING until the run ends, and remains so if the process was killed.
RUNNING, DONE, FAILED, INTERRUPTED = "running", "done", "failed", "interrupted"


def make_summary(
    run: Run, metrics: Mapping[str, float], events: Sequence[Event], *, wall_s: float,
    solver: Mapping[str, float] | None, messages: Mapping[str, int] | None = None, **happened: Any,
) -> dict[str, Any]:
    """Assemble the summary of a completed run, in the same form for ``simulate`` and the graph.

    Args:
        run: the run.
        metrics: results of the run, by their names in
            :data:`greenroof_ros.results.metrics.METRICS`.
        events: rain events.
        wall_s: wall time of the run (s).
        solver: statistics of the controller's solver; None if there is no solver.
        messages: number of messages on each topic in the bag.
        happened: what happened in the run, as for :func:`make_unfinished_summary`.
    """
    return {
        **make_unfinished_summary(run, DONE, **happened | {"last_tick": run.steps}),
        "frost_hours": run.series.frost_hours,
        "precipitation_in_frost_mm": run.series.precipitation_in_frost,
        **metrics,
        "events": event_rows(run.start, events),
        "solver": solver and dict(solver),
        "wall_s": wall_s,
        "times_real_time": run.steps * run.site.tau / wall_s,
        "messages": dict(messages or {}),
    }


def make_unfinished_summary(run: Run, status: str, **happened: Any) -> dict[str, Any]:
    """Assemble the summary of an unfinished run, without metrics, which apply only to whole runs.

    Args:
        run: the run.
        status: status of the run, such as :data:`RUNNING`.
        happened: what happened so far, under the keys of the summary: ``reason``, why the run
            ended; ``last_tick``, the last tick that the plant reported; ``refused``, the number of
            rejected values by topic; ``parameter_changes``, the latest ones with their ticks, and
            ``parameter_change_count``, the number of all.
    """
    choice = run.forecast_choice
    return {
        "status": status,
        "reason": None,
        "last_tick": None,
        "controller": run.controller.name,
        "controller_reference": run.controller.reference,
        "parameters": replace_infinity(run.parameters),
        **describe_setting(run),
        "gaps": run.weather.gaps,
        **asdict(run.weather.climate),
        "forecast": {
            "model": choice.model,
            **choice.options(),
            **({"file": str(choice.file)} if choice.file is not None else {}),
        },
        "sensor_and_pump": run.sensor_and_pump.values(),
        "filled_hours": run.series.filled_hours,
        "refused": {},
        "parameter_changes": [],
        "parameter_change_count": 0,
        "versions": dict(versions()),
        **happened,
    }


def describe_setting(run: Run) -> dict[str, Any]:
    """Return the location and time of a run, and the notes that precede its results."""
    weather = run.weather
    layer = {} if run.site.drainage_storage is None else {"layer_m3": run.site.initial_layer}
    return {
        "initial": {"name": run.initial, "cistern_m3": run.x1, "roof_m3": run.x2, **layer},
        "start": run.start.isoformat(),
        "steps": run.steps,
        "tau_s": run.site.tau,
        "site": str(run.site_file or SITE_FILE),
        "place": [run.site.latitude, run.site.longitude],
        "weather": weather.source,
        "weather_places": [list(place) for place in dict.fromkeys(weather.places.values())],
        "weather_from": weather.first.isoformat(),
        "weather_until": weather.end.isoformat(),
        "evapotranspiration_method": weather.method,
        "notes": run.notes(),
        "weather_notes": run.weather_notes(),
        "weather_summary": run.series.summary,
    }


def write(summary: Mapping[str, Any], directory: Path) -> None:
    """Write a summary to the directory of its run, atomically if possible.

    The table of events is written together with the summary of a completed run. If the disk is too
    full for a second file, the old file is overwritten, so that the end of the run is still
    recorded.

    Raises:
        OSError: if the summary cannot be written.
    """
    path = directory / SUMMARY
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    try:
        replace_text(path, text)
    except OSError as error:
        try:
            with path.open("r+", encoding="utf-8") as stream:
                stream.write(text)
                stream.truncate()
        except OSError:
            # The error from a write does not name the file.
            raise OSError(error.errno, error.strerror, str(path)) from error
    if "events" in summary:
        replace_text(directory / EVENTS, format_events(summary["events"]))
