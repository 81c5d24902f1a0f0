"""Pumps from the fall of their cistern: twins of the plant, measured with a noise of 2 mm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from twins import DAY, NOISE_M, STEP_S, TWIN, a_record, storms

from greenroof_ros.analysis.calibration.pumps import PumpFit, fit_pumps
from greenroof_ros.analysis.calibration.record import RoofRecord
from greenroof_ros.common.quality import Severity
from greenroof_ros.model.plant import Plant, maximum_pump_flow
from greenroof_ros.model.site import Site

TICK_S = 60.0
SITE = replace(TWIN, a_in=1000.0)
"""with the pump curve of Table I, and a catchment whose rain refills the cistern"""


@cache
def twin(
    site: Site, days: int, seed: int = 1, *, refills: bool = False, shortest: bool = False
) -> RoofRecord:
    """A cistern with pumps that run twice a day: ten minutes at full command, twenty at half.

    The shortest runs are five minutes at full command. With refills, once a week 1 to 5 m3 come
    in 5 to 15 min, during a run or near it.
    """
    random = np.random.default_rng(seed)
    rain = storms(days, random)
    step = np.arange(days * DAY)
    command = np.where(step % DAY // 2 == 36, 1.0, np.where(step % DAY // 4 == 54, 0.5, 0.0))
    delivered = np.zeros(len(rain))
    for week in range(0, len(rain) if refills else 0, 7 * DAY):
        begins = week + np.flatnonzero(np.diff(command[week:week + 7 * DAY]) > 0) + 1
        at = random.choice(begins) + random.integers(-1, 4)
        lasts = random.integers(1, 4)
        delivered[at:at + lasts] = random.uniform(1.0, 5.0) / lasts
    if shortest:
        command[:] = step % (DAY // 2) == 72
    plant = Plant(replace(site, tau=TICK_S), 2.5 * site.a1, 0.0)
    level = []
    for now, fell in enumerate(rain.tolist()):
        level.append(plant.levels()[0])
        if level[-1] < site.suction_level + 0.3:
            command[now] = 0.0
        precipitation = fell / 1000 / STEP_S
        for _ in range(round(STEP_S / TICK_S)):
            pumped = float(command[now]) * maximum_pump_flow(site, plant.x1)
            plant.step(precipitation, plant.flows(precipitation, 0.0, pumped))
            plant.x1 += float(delivered[now]) * TICK_S / STEP_S
    cistern = np.array(level) + random.normal(0, NOISE_M, len(level))
    return a_record(rain, float(STEP_S), cistern=cistern, command=command)


def later(record: RoofRecord, steps: int) -> RoofRecord:
    """Return a record with a pump state that is late by some steps; the pumps stand at its ends."""
    return replace(record, command=np.roll(record.command, steps))


def cases(pumps: PumpFit) -> list[str]:
    return [finding.case for finding in pumps.findings]


def hits(pumps: PumpFit, true: Site) -> bool:
    """Return whether the true pumps' flow (l/s) lies in the interval."""
    assert cases(pumps)[0] == "flow"
    figures = pumps.findings[0].figures
    flow = 1000 * maximum_pump_flow(true, figures["level"] * SITE.a1)
    return abs(figures["flow"] - flow) <= figures["half"]


WORN = replace(SITE, c_hat=48.0)
"""deliver a tenth less than the site's curve; levels change the head of 40 m by 2 m"""


def test_the_flow_of_worn_pumps_is_found() -> None:
    """With a refill a week, a fifth to all of a run's volume."""
    pumps = fit_pumps(SITE, twin(WORN, 60, refills=True))
    assert cases(pumps) == ["flow", "left out"] and hits(pumps, WORN)
    figures = pumps.findings[0].figures
    assert figures["runs"] > 20
    assert figures["half"] < 0.01 * figures["flow"]
    shape, height = pumps.parameters
    assert (shape.name, shape.value, shape.interval) == ("a_hat", SITE.a_hat, "")
    assert shape.reason == "the data cannot tell it apart from c_hat"
    assert height.name == "c_hat"
    assert height.low <= 48.0 <= height.high
    assert pumps.site == replace(SITE, c_hat=height.value)


@pytest.mark.parametrize("steps", [-2, 1])
def test_a_pump_state_that_is_late_or_early_does_not_matter(steps: int) -> None:
    pumps = fit_pumps(SITE, later(twin(WORN, 30), steps))
    assert cases(pumps) == ["flow", "shifted"] and hits(pumps, WORN)
    figures = pumps.findings[0].figures
    assert figures["half"] < 0.02 * figures["flow"]
    assert figures["late_s"] == pytest.approx(steps * STEP_S, abs=max(figures["late_half_s"], 5.0))
    assert pumps.findings[1].figures["side"] == ("late" if steps > 0 else "early")
    assert f" is {5 * abs(steps)} min " in pumps.findings[1].text


def test_short_runs_are_reported_to_tell_less() -> None:
    """Runs of one step, with a pump state that is a step late."""
    pumps = fit_pumps(SITE, later(twin(SITE, 30, shortest=True), 1))
    assert cases(pumps)[-1] == "short" and hits(pumps, SITE)


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


def test_of_pumps_with_little_head_the_whole_curve_is_found() -> None:
    """A lift of 2 to 4 m, depending on the cistern's level."""
    low = replace(SITE, d=3.0, c_hat=4.0, a_hat=-9e4)
    pumps = fit_pumps(replace(low, c_hat=5.0, a_hat=-6e4), twin(low, 60))
    assert hits(pumps, low)
    for fitted in pumps.parameters:
        assert fitted.low <= getattr(low, fitted.name) <= fitted.high
        assert fitted.value == pytest.approx(getattr(low, fitted.name), rel=0.1)
        assert fitted.reason == ""


def test_where_no_run_is_seen_nothing_is_reported() -> None:
    """Rain all the time; the cistern at its outlet or its valve; gaps that split all runs."""
    record = twin(WORN, 30)
    level = record.cistern.copy()
    level[::2] = np.nan  # no step of a run lies between two values
    for site, seen in (
        (SITE, replace(record, rain=np.full(record.steps, 0.01))),
        (replace(SITE, z_o=1.0), record),
        (replace(SITE, mains_level=2.9, mains_flow=0.001), record),
        (SITE, replace(record, cistern=level)),
    ):
        pumps = fit_pumps(site, seen)
        assert (cases(pumps), pumps.site, pumps.parameters) == (["unseen"], site, ())
    for unknown in ("command", "cistern"):
        assert cases(fit_pumps(SITE, replace(record, **{unknown: None}))) == []


def test_what_no_pumps_do_is_refused() -> None:
    """A cistern that stands still; percent labelled as shares; a clock three steps late."""
    record = twin(WORN, 30)
    still = np.random.default_rng(1).normal(2.0, NOISE_M, record.steps)
    for wrong, code, text in (
        (replace(record, cistern=still), "unit-error", "cistern level: falls while the pumps run"),
        (replace(record, command=record.command * 100), "unit-error", "as if they lifted 0.07"),
        (later(record, 3), "clock-shifted", "pump state: is more than 10 min after the"),
    ):
        pumps = fit_pumps(SITE, wrong)
        (finding,) = pumps.findings
        assert (finding.code, finding.severity) == (code, Severity.REFUSAL)
        assert text in finding.text
        assert (pumps.site, pumps.parameters) == (SITE, ())
