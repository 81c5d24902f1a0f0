"""Pumps from the fall of their cistern: twins of the plant, measured with a noise of 2 mm."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from twins import NOISE_M, STEP_S, TWIN, storms

from greenroof_ros.calibration.pump import fit_pump
from greenroof_ros.calibration.record import Record
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.plant import Plant, maximum_pump_flow
from greenroof_ros.model.site import Site

TICK_S = 30.0
DAY = 86400 // STEP_S
SITE = replace(TWIN, a_in=1000.0)
"""With the pump curve of Table I, and rain of a catchment that fills the cistern again."""


def twin(
    site: Site, days: int, seed: int, *, refills: bool = False, shortest: bool = False
) -> Record:
    """A cistern whose pumps run twice a day: ten minutes at full command, twenty at half.

    The shortest runs are of five minutes at full command. If it is refilled, then once a week
    during a run or beside it, with 1 to 5 m3 in 5 to 15 min.
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
    nothing = np.zeros(len(rain))
    return Record(
        Path("record.csv"), datetime(2021, 5, 1, tzinfo=timezone.utc), float(STEP_S), rain,
        nothing, nothing, None, None,
        cistern=np.array(level) + random.normal(0, NOISE_M, len(level)), command=command,
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_flow_of_worn_pumps_is_found(seed: int) -> None:
    """They lift a tenth less than the site's curve says; levels change the head of 40 m by 2."""
    worn = replace(SITE, c_hat=48.0)
    found = fit_pump(SITE, twin(worn, 60, seed))
    assert found is not None
    assert found.runs > 20
    true = maximum_pump_flow(worn, found.level * SITE.a1)
    assert found.flow == pytest.approx(true, abs=found.half)
    assert found.half < 0.01 * true
    assert found.late == pytest.approx(0.0, abs=found.late_half)
    assert (found.left_out, found.words) == (0, [])
    shape, height = found.parameters
    assert (shape.name, shape.value) == ("a_hat", SITE.a_hat)
    assert shape.words == "the data cannot tell it apart from c_hat"
    assert not shape.told
    assert height.name == "c_hat"
    assert height.low <= 48.0 <= height.high
    assert found.site == replace(SITE, c_hat=height.value)


def later(record: Record, steps: int) -> Record:
    """A record whose pump state is late by some steps; at its beginning or end the pumps stand."""
    return replace(record, command=np.roll(record.command, steps))


@pytest.mark.parametrize("steps", [-2, -1, 1, 2])
def test_a_pump_state_that_is_late_or_early_does_not_matter(steps: int) -> None:
    worn = replace(SITE, c_hat=48.0)
    found = fit_pump(SITE, later(twin(worn, 30, 1), steps))
    assert found is not None
    assert found.flow == pytest.approx(
        maximum_pump_flow(worn, found.level * SITE.a1), abs=found.half
    )
    assert found.half < 0.02 * found.flow
    assert found.late == pytest.approx(steps * STEP_S, abs=max(found.late_half, 5.0))
    assert found.words == [
        f"The pump state is {5 * abs(steps)} min {'late' if steps > 0 else 'early'} against the "
        "cistern's fall"
    ]


def test_a_pump_state_of_another_clock_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="pump state: is more than 10 min after the cist"):
        fit_pump(SITE, later(twin(SITE, 30, 1), 3))


def test_refills_do_not_matter() -> None:
    """One a week, of a fifth to all of what a run takes."""
    worn = replace(SITE, c_hat=48.0)
    found = fit_pump(SITE, twin(worn, 60, 1, refills=True))
    assert found is not None
    assert found.flow == pytest.approx(
        maximum_pump_flow(worn, found.level * SITE.a1), abs=found.half
    )
    assert found.half < 0.01 * found.flow
    assert found.left_out > 0


def test_short_runs_are_said_to_tell_less() -> None:
    """Runs of one step, with a pump state that is a step late."""
    record = later(twin(SITE, 30, 1, shortest=True), 1)
    found = fit_pump(SITE, record)
    assert found is not None
    assert found.flow == pytest.approx(
        maximum_pump_flow(SITE, found.level * SITE.a1), abs=found.half
    )
    assert found.words[-1].startswith("Nine in ten runs last 1 steps or less: the")


@pytest.mark.parametrize("refills", [False, True])
def test_intervals_of_one_week_hold_the_truth(refills: bool) -> None:
    """In 20 records of ten runs and more; right intervals miss four times and more in 1.6 %."""
    worn = replace(SITE, c_hat=48.0)
    inside, fits, seed = 0, 0, 0
    while fits < 20:
        seed += 1
        found = fit_pump(SITE, later(twin(worn, 7, seed, refills=refills), 1))
        if found is not None:
            fits += 1
            true = maximum_pump_flow(worn, found.level * SITE.a1)
            inside += abs(found.flow - true) <= found.half
    assert inside >= 17


def test_of_pumps_with_little_head_the_whole_curve_is_found() -> None:
    """A lift of 2 to 4 m, as the cistern stands."""
    low = replace(SITE, d=3.0, c_hat=4.0, a_hat=-9e4)
    found = fit_pump(replace(low, c_hat=5.0, a_hat=-6e4), twin(low, 60, 1))
    assert found is not None
    assert found.flow == pytest.approx(
        maximum_pump_flow(low, found.level * SITE.a1), abs=found.half
    )
    for one in found.parameters:
        assert one.low <= getattr(low, one.name) <= one.high
        assert one.value == pytest.approx(getattr(low, one.name), rel=0.1)
        assert one.words == ""


def test_rain_and_outlet_do_not_count() -> None:
    """It rains all the time, or the cistern stands at its outlet: there is no run to see."""
    record = twin(SITE, 10, 1)
    assert fit_pump(SITE, replace(record, rain=np.full(record.steps, 0.01))) is None
    assert fit_pump(replace(SITE, z_o=1.0), record) is None
    assert fit_pump(replace(SITE, mains_level=2.9, mains_flow=0.001), record) is None


def test_gaps_part_runs() -> None:
    """Every other level is missing: between two there is never one step of a run."""
    record = twin(SITE, 10, 1)
    level = record.cistern.copy()
    level[::2] = np.nan
    assert fit_pump(SITE, replace(record, cistern=level)) is None


def test_without_a_command_nothing_is_fitted() -> None:
    record = twin(SITE, 10, 1)
    assert fit_pump(SITE, replace(record, command=None)) is None
    assert fit_pump(SITE, replace(record, cistern=None)) is None


def test_a_cistern_that_stands_still_is_refused() -> None:
    record = twin(SITE, 20, 1)
    level = np.random.default_rng(1).normal(2.0, NOISE_M, record.steps)
    with pytest.raises(ConfigurationError) as error:
        fit_pump(SITE, replace(record, cistern=level))
    assert str(error.value).startswith("record.csv: cistern level: falls while the pumps run as if")
    assert "is the sensor stuck, a unit wrong, a clock shifted" in str(error.value)


def test_a_pump_state_in_a_wrong_unit_is_refused() -> None:
    """Percent that are called shares: the pumps would lift a hundredth of 8 l/s."""
    record = twin(SITE, 20, 1)
    with pytest.raises(ConfigurationError, match=r"as if they lifted 0\.08\d l/s"):
        fit_pump(SITE, replace(record, command=record.command * 100))
