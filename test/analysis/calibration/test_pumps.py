"""Pumps from the fall of their cistern: twins of the plant, measured with a noise of 2 mm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import refusal
from twins import DAY, NOISE_M, STEP_S, TWIN, a_record, storms

from greenroof_ros.analysis.calibration.pumps import PumpFit, fit_pumps
from greenroof_ros.analysis.calibration.step_record import StepRecord
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.tick import step
from greenroof_ros.site.site import Site

TICK_S = 60.0
SITE = replace(TWIN, a_in=1000.0)
"""with the pump curve of Table I, and a catchment whose rain refills the cistern"""


@cache
def twin(
    site: Site, days: int, seed: int = 1, *, refills: bool = False
) -> StepRecord:
    """A cistern with pumps that run twice a day: ten minutes at full command, twenty at half.

    With refills, once a week 1 to 5 m3 come
    in 5 to 15 min, during a run or near it.
    """
    random = np.random.default_rng(seed)
    rain = storms(days, random)
    number = np.arange(days * DAY)
    command = np.where(number % DAY // 2 == 36, 1.0, np.where(number % DAY // 4 == 54, 0.5, 0.0))
    delivered = np.zeros(len(rain))
    for week in range(0, len(rain) if refills else 0, 7 * DAY):
        begins = week + np.flatnonzero(np.diff(command[week:week + 7 * DAY]) > 0) + 1
        at = random.choice(begins) + random.integers(-1, 4)
        lasts = random.integers(1, 4)
        delivered[at:at + lasts] = random.uniform(1.0, 5.0) / lasts
    p, state = plant_parameters(replace(site, tau=TICK_S)), State(2.5 * site.a1, 0.0, 0.0)
    level = []
    for now, fell in enumerate(rain.tolist()):
        level.append(state.cistern / site.a1)
        if level[-1] < site.suction_level + 0.3:
            command[now] = 0.0
        came = float(delivered[now]) * TICK_S / STEP_S
        for _ in range(round(STEP_S / TICK_S)):
            pumped = float(command[now]) * maximum_pump_flow(site, state.cistern)
            state, _ = step(p, state, fell / 1000 / STEP_S, 0.0, 0.0, 1.0, pumped)
            state = state._replace(cistern=state.cistern + came)
    cistern = np.array(level) + random.normal(0, NOISE_M, len(level))
    return a_record(rain, float(STEP_S), cistern=cistern, command=command)


def later(record: StepRecord, steps: int) -> StepRecord:
    """Return a record with a pump state that is late by some steps; the pumps stand at its ends."""
    return replace(record, command=np.roll(record.command, steps))


def hits(pumps: PumpFit, true: Site) -> bool:
    """Return whether the true pumps' flow lies in the interval."""
    flow = maximum_pump_flow(true, pumps.level * SITE.a1)
    return abs(pumps.flow - flow) <= pumps.half


WORN = replace(SITE, c_hat=48.0)
"""deliver a tenth less than the site's curve"""


@pytest.mark.parametrize("steps", [-2, 0, 1])
def test_the_flow_of_worn_pumps_is_found(steps: int) -> None:
    """With a refill a week, a fifth to all of a run's volume, and a pump state early or late."""
    pumps = fit_pumps(SITE, later(twin(WORN, 60, refills=True), steps))
    assert hits(pumps, WORN)
    assert pumps.runs > 20
    assert pumps.half < 0.02 * pumps.flow
    shape, height = pumps.parameters
    assert (shape.name, shape.value, shape.interval) == ("a_hat", SITE.a_hat, "")
    assert height.name == "c_hat"
    assert height.low <= 48.0 <= height.high
    assert pumps.site == replace(SITE, c_hat=height.value)


def test_intervals_of_one_week_hold_the_truth() -> None:
    """12 records with ten runs or more; correct intervals miss three or more times in 2 %."""
    inside, fits, seed = 0, 0, 0
    while fits < 12:
        seed += 1
        pumps = fit_pumps(SITE, later(twin(WORN, 7, seed, refills=True), 1))
        if pumps.parameters:
            fits += 1
            inside += hits(pumps, WORN)
    assert inside >= 10


def test_the_flow_at_the_mean_level_of_pumps_with_little_head_is_found() -> None:
    """A lift of 2 to 4 m, depending on the cistern's level, from a curve that is another."""
    low = replace(SITE, d=3.0, c_hat=4.0, a_hat=-9e4)
    pumps = fit_pumps(replace(low, c_hat=5.0, a_hat=-6e4), twin(low, 60))
    true = maximum_pump_flow(low, pumps.level * SITE.a1)
    assert pumps.flow == pytest.approx(true, rel=0.02)
    assert maximum_pump_flow(pumps.site, pumps.level * SITE.a1) == pytest.approx(pumps.flow)


def test_where_no_run_is_seen_nothing_is_fitted() -> None:
    """Rain all the time; the cistern at its outlet or its valve; gaps that split all runs."""
    record = twin(WORN, 30)
    level = record.cistern.copy()
    level[::2] = np.nan  # no step of a run lies between two values
    for site, seen in (
        (SITE, replace(record, rain=np.full(record.steps, 0.01))),
        (replace(SITE, z_o=1.0), record),
        (replace(SITE, mains_level=2.9, mains_flow=0.001), record),
        (SITE, replace(record, cistern=level)),
        (SITE, replace(record, command=None)),
        (SITE, replace(record, cistern=None)),
    ):
        pumps = fit_pumps(site, seen)
        assert (pumps.site, pumps.parameters, pumps.runs) == (site, (), 0)


def test_what_no_pumps_do_is_refused() -> None:
    """A cistern that stands still; percent labelled as shares; a clock that is hours late."""
    record = twin(WORN, 30)
    still = np.random.default_rng(1).normal(2.0, NOISE_M, record.steps)
    for wrong in (
        replace(record, cistern=still), replace(record, command=record.command * 100),
        later(record, 30),
    ):
        refusal(fit_pumps, SITE, wrong, match="cistern level: falls while the pumps run")
