"""One run of a real season, and its results in a file, so that no run is made twice."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from real_seasons.ideal import ideal_forecast
from real_seasons.inputs import Inputs, Period

from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.models import FileModel
from greenroof_ros.forecast.resampling import Known, Rain, SteppedForecast
from greenroof_ros.formats.records import Archive
from greenroof_ros.model.initial_state import initial_state
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.metrics import Metrics

Array = NDArray[np.float64]

# A sixtieth of the flow lifts in a minute what full flow lifts in a second, the paper's tick.
ONOFF = {"fraction": 1 / 60}
ISSUED, DRESSED, CROSSED = "as issued", "dressed", "dressed by the other half"
NESTED = "dressed by the other half with its own numbers"
SCALED, SCALED_BY_ITSELF = "scaled by the other half", "scaled by its own half"
IDEAL = "used ideally"
PERFECT, ONOFF_NAME, NO_RAIN = "perfect", "on/off", "no rain"
SOURCES = ("three", "placebo", "GEM", "KNMI", "GFS")


@dataclass(frozen=True)
class Case:
    """A run: a period on a roof, and how it is controlled."""

    roof: str
    period: Period
    source: str
    form: str = ISSUED
    trusts: bool = True
    """whether trust is learned; otherwise the forecast is trusted in full"""
    hour: bool = True
    """whether the gauge's rain in this minute counts as the whole hour's"""
    draw: int = 0
    """of the ensemble that stands for an ideal use"""

    @property
    def name(self) -> str:
        """Its name in tables."""
        words = [self.source]
        words += [] if self.form == ISSUED else [self.form]
        words += ["trusted in full"] if not self.trusts and self.source in SOURCES else []
        words += [] if self.hour else ["the hour as forecast"]
        words += [f"draw {self.draw}"] if self.draw else []
        return ", ".join(words)

    def file(self, directory: Path) -> Path:
        """Return the file of its result."""
        place, name = (
            re.sub(r"\W+", "_", words)
            for words in (f"{self.roof} {self.period.words}", self.name)
        )
        flow = f"_{ONOFF['fraction']:.4f}" if self.source == ONOFF_NAME else ""
        return directory / place / f"{name}{flow}.json"


class HourAsForecast(SteppedForecast):
    """Knows the rain at this moment, and for the rest of the hour only the forecast."""

    def _known_in(self, hour: int) -> Known:
        """Return the newest forecast in an hour, that hour included."""
        rain, evapotranspiration = self._model.known(hour, self._hours(hour))
        present = min(hour, len(self._weather.precipitation) - 1)
        self._now = self._weather.precipitation[present] / 1000 / 3600
        evapotranspiration[0] = self._weather.evapotranspiration[present]
        return Known(
            self._model.issued(hour), rain, evapotranspiration, self._site.a2, self._ends
        )

    def precipitation(self, tick: int) -> Rain:
        """Return the means of the steps (m/s); the first is observed."""
        rain = np.array(super().precipitation(tick))
        rain[..., 0] = self._now
        return rain


def write(case: Case, inputs: Inputs, file: Path) -> None:
    """Run a case, and write its results.

    They are the metrics at the end and at the end of each week, the deviation in each week (m3),
    and /controller/trust at the beginning of each day.
    """
    run = build(case, inputs)
    controller, metrics = run.make_controller(), Metrics()
    trust, day = [], round(86_400 / run.site.tau)
    until = []
    for tick in closed_loop(run, controller, metrics):
        if tick.k % day == 0:
            trust.append(getattr(controller, "trust", None))
        if tick.k and tick.k % (7 * day) == 0 and tick.k < run.steps:
            until.append(metrics.results())
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(".part")
    unfinished.write_text(json.dumps({
        "metrics": metrics.results(), "until": [*until, metrics.results()],
        "weeks": metrics.weekly_deviations(), "trust": trust,
        "controller": controller.statistics(),
    }), encoding="utf-8")
    unfinished.rename(file)


def build(case: Case, inputs: Inputs) -> Run:
    """Return the run of a case, with its controller and forecasts."""
    site, weather = inputs.sites[case.roof], inputs.weather[case.roof]
    onoff = case.source == ONOFF_NAME
    controller = find_controller("onoff" if onoff else "lookahead")
    parameters = {**controller.defaults(site), **(ONOFF if onoff else {})}
    if not case.trusts:
        parameters["trust_memory"] = 0.0
    run = build_run(
        inputs.site_file(case.roof), site, weather, case.period.start.isoformat(),
        count_ticks(site, case.period.hours, "hours"), controller, parameters, "low-low",
        initial_state(site, "low-low"),
        ideal_forecast(inputs, case.source, case.draw) if case.form == IDEAL else ForecastChoice(),
    )
    archive = _archive(case, inputs)
    if archive is None:
        return run
    known = SteppedForecast if case.hour else HourAsForecast
    return replace(run, forecast=known(
        FileModel(archive, weather, all_members=True), weather, site, run.start,
        growing_steps(parameters["horizon"]), run.steps, all_members=True,
    ))


def _archive(case: Case, inputs: Inputs) -> Archive | None:
    """Return the archive of a case; None if it has none."""
    if case.source in (ONOFF_NAME, PERFECT) or case.form == IDEAL:
        return None
    if case.form == DRESSED:
        return inputs.dressed(case.roof, case.source)
    if case.form in (CROSSED, NESTED):
        return inputs.crossed(case.roof, case.source, case.period, case.form == NESTED)
    if case.form in (SCALED, SCALED_BY_ITSELF):
        own_half = case.form == SCALED_BY_ITSELF
        return inputs.scaled(case.roof, case.source, case.period, own_half)
    return inputs.issued[case.source]
