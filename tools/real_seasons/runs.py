"""One run of the season, and its results in a file, so that no run is made twice."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

from real_seasons.inputs import NO_RAIN, SERVICES, TOGETHER, read_issued, site_file, weather_file

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.models import FileModel
from greenroof_ros.forecast.resampling import SteppedForecast
from greenroof_ros.model.initial_state import initial_state
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.site import read_site
from greenroof_ros.weather.reading import read_weather

ONOFF, PERFECT = "on/off", "perfect"
FORECASTS = (ONOFF, NO_RAIN, *SERVICES, TOGETHER, PERFECT)

# A sixtieth of the flow lifts in a minute what full flow lifts in a second, the paper's tick.
_FRACTION = 1 / 60
_WEEK_S = 7 * 86_400


@dataclass(frozen=True)
class Case:
    """A run: a roof, on/off or the forecast that ``lookahead`` gets, and a time."""

    roof: str
    forecast: str
    start: datetime = datetime(2024, 5, 1, tzinfo=timezone.utc)
    hours: float = 4416.0
    """length of the run; by default May to October"""

    def file(self, directory: Path) -> Path:
        """Return the file of its results."""
        return directory / (re.sub(r"\W+", "_", f"{self.roof} {self.forecast}") + ".json")


def write(case: Case, archives: Path, directory: Path) -> Path:
    """Run a case; write and return its file: the metrics at the end of each week."""
    file = case.file(directory)
    unfinished = file.with_suffix(".part")
    unfinished.write_text(json.dumps(metrics_by_week(build(case, archives, directory))), "utf-8")
    return unfinished.rename(file)


def metrics_by_week(run: Run) -> list[dict[str, float]]:
    """Return the metrics of a run from its beginning to the end of each week."""
    metrics, until = Metrics(), []
    week = round(_WEEK_S / run.site.tau)
    for tick in closed_loop(run, run.make_controller(), metrics):
        if tick.k and tick.k % week == 0 and tick.k < run.steps:
            until.append(metrics.results())
    return [*until, metrics.results()]


def build(case: Case, archives: Path, directory: Path) -> Run:
    """Return the run of a case, with its controller and forecasts."""
    file = site_file(directory, case.roof)
    site = read_site(file)
    weather = read_weather([weather_file(directory)], site, "assumed", "fill")
    controller = find_controller("onoff" if case.forecast == ONOFF else "lookahead")
    parameters = controller.defaults(site)
    if case.forecast == ONOFF:
        parameters["fraction"] = _FRACTION
    run = build_run(
        file, site, weather, case.start.isoformat(), count_ticks(site, case.hours, "hours"),
        controller, parameters, "low-low", initial_state(site, "low-low"), ForecastChoice(),
    )
    if case.forecast in (ONOFF, PERFECT):
        return run
    model = FileModel(read_issued(archives, site, case.forecast), weather, all_members=True)
    return replace(run, forecast=SteppedForecast(
        model, weather, site, run.start, growing_steps(parameters["horizon"]), run.steps,
        all_members=True,
    ))
