"""What the best use of a service could gain: with an ensemble that knows as much, and no more.

The service's scores give its coherence s with the rain that falls, by lead and frequency (see
:mod:`greenroof_ros.forecast.skill`). Given its forecast f, the normal variable z of that rain has
the mean s f and the variance 1 - s^2. Members drawn from this distribution have the coherence s^2
with z and with each other, so they are generated with a skill that has s^2 in place of s, and no
wet bias. Each draw is another forecast that the service might have made.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from real_seasons.inputs import HOURS_OF, SERVICES, Inputs

from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.forecast.skill import Skill
from greenroof_ros.verification.fitting import fit_skill, skill_text
from greenroof_ros.verification.pairs import Sum, issued_forecasts, tally

MEMBERS = 10
DRAWS = (1, 2, 3)
# The sums (h) and events (mm) of greenroof verify.
_SUMS = (Sum(1, 1.0), Sum(6, 2.0), Sum(12, 3.0), Sum(24, 5.0))
_DAYS = 5


def ideal_forecast(inputs: Inputs, source: str, draw: int) -> ForecastChoice:
    """Return the ensemble that stands for the best use of a service."""
    file = inputs.scratch / f"ideal_{source}.yaml"
    if not file.exists():
        _write(inputs, source, file)
    return ForecastChoice("ensemble", skill=str(file), seed=draw, members=MEMBERS)


def _write(inputs: Inputs, source: str, file: Path) -> None:
    """Fit a service's skill at the gauge, and write the skill of its best use."""
    archive = inputs.archives / f"{SERVICES[source]}_previous_runs.csv"
    site, hours = inputs.sites["measured"], HOURS_OF.get(source, 24 * _DAYS)
    forecasts = issued_forecasts(ForecastChoice("file", file=archive), inputs.record, site, hours)
    tallies = tally(forecasts, inputs.record.precipitation, 24, _SUMS, lambda _: None)
    skill = fit_skill(tallies, forecasts.older, inputs.record.precipitation, lambda _: None)
    file.write_text(skill_text(squared(skill), source), encoding="utf-8")


def squared(skill: Skill) -> Skill:
    """Return a skill with the coherence s^2 for s, and without bias or error of evaporation."""
    errors = skill.errors
    return replace(skill, errors=replace(
        errors, reach=errors.reach / 2 ** (1 / errors.fading), timing=math.sqrt(2) * errors.timing,
        wetness=0.0, amount=1.0, evapotranspiration=0.0,
    ))
