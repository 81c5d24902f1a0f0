"""The fit finds the roof that made a record, and says what it cannot find."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student
from twins import FILLED_AT_FIRST, TWIN, record_rows, summed, write

from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.fit import FILLED, fit, half_intervals, moves, ranges
from greenroof_ros.calibration.record import Record, comparable

DAYS = 45
ELSEWHERE = replace(
    TWIN, field_capacity=0.3, z_cap=3.0, wilting_point=0.02, depletion_fraction=0.5,
    drainage_time=300.0, crop_coefficient=1.0,
)
"""Where the fit begins."""


def true_value(name: str) -> float:
    """What the twin's parameter is."""
    return FILLED_AT_FIRST if name == FILLED else float(getattr(TWIN, name))



@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    file = tmp_path_factory.mktemp("twin") / "twin.csv"
    return read_csv_record(write(record_rows(TWIN, DAYS, 2), file), TWIN)


def test_a_twin_is_recovered(tmp_path: Path) -> None:
    """From six weeks, with noise of 2 mm and gaps."""
    rows = record_rows(TWIN, DAYS, 2, tick_s=1.0)
    record = read_csv_record(write(rows, tmp_path / "twin.csv"), TWIN)
    parameters = fit(ELSEWHERE, record, comparable(record)).parameters
    assert {one.name for one in parameters if one.told} == {
        "field_capacity", "wilting_point", "depletion_fraction", "drainage_time",
        "crop_coefficient", "filled",
    }
    for one in parameters:
        assert one.low <= true_value(one.name) <= one.high, one
        assert one.value == pytest.approx(true_value(one.name), rel=0.05), one


def test_runoff_alone_tells_only_what_the_soil_holds_between(record: Record) -> None:
    """Field capacity and wilting point count by their difference; the level tells them apart.

    So the interval of the field capacity allows for any wilting point, also for the true one.
    """
    record = replace(record, level=None)
    found = fit(ELSEWHERE, record, record.known)
    by_name = {one.name: one for one in found.parameters}
    assert not by_name["wilting_point"].told
    assert "cannot tell it apart from field_capacity" in by_name["wilting_point"].words
    assert by_name["wilting_point"].value == pytest.approx(0.02)
    true = TWIN.field_capacity - TWIN.wilting_point
    capacity = by_name["field_capacity"]
    assert capacity.value - 0.02 == pytest.approx(true, rel=0.05)
    assert capacity.low < TWIN.field_capacity < capacity.high
    highest = next(one.high for one in ranges(ELSEWHERE, record) if one.name == "wilting_point")
    assert capacity.high - capacity.value == pytest.approx(highest - 0.02, rel=0.15)


def test_levels_alone_tell_nothing_of_the_drainage_layer(record: Record) -> None:
    found = fit(ELSEWHERE, replace(record, runoff=None), record.known)
    by_name = {one.name: one for one in found.parameters}
    assert by_name["drainage_time"].words == "the data do not depend on it"
    assert by_name["drainage_time"].value == pytest.approx(300.0)
    assert by_name["field_capacity"].value == pytest.approx(TWIN.field_capacity, rel=0.03)


@pytest.mark.parametrize("hours", [1, 6])
def test_longer_steps_do_not_make_more_runoff(hours: int, tmp_path: Path) -> None:
    """Of 150 days, with the true drainage time in the site file: of six hours it is not fitted.

    Rain comes evenly in a simulated step, and so runs off late. Step against step, a fit of these
    records of six hours makes up for that by 15 % more runoff.
    """
    rows = summed(record_rows(TWIN, 150, 2, gaps=False), hours)
    record = read_csv_record(write(rows, tmp_path / "sums.csv"), TWIN)
    site = replace(ELSEWHERE, drainage_time=TWIN.drainage_time)
    found = fit(site, record, record.known)
    for one in found.parameters:
        assert not one.told or one.low <= true_value(one.name) <= one.high, one
    told = {one.name: one.value for one in found.parameters if one.told}
    assert told["field_capacity"] == pytest.approx(TWIN.field_capacity, rel=0.02)
    assert told["crop_coefficient"] == pytest.approx(TWIN.crop_coefficient, rel=0.05)
    assert ("drainage_time" in told) == (hours == 1)
    simulated, measured = (
        series[record.known].sum() for series in (found.simulated.runoff, record.runoff)
    )
    assert simulated == pytest.approx(measured, rel=0.02)


def test_of_daily_sums_the_soil_is_found(tmp_path: Path) -> None:
    """Of 150 days' sums and morning levels; how fast the roof drains they cannot tell."""
    rows = summed(record_rows(TWIN, 150, 1, gaps=False), 24)
    record = read_csv_record(write(rows, tmp_path / "days.csv"), TWIN)
    found = fit(ELSEWHERE, record, record.known)
    by_name = {one.name: one for one in found.parameters}
    for name in ("field_capacity", "wilting_point", "crop_coefficient", "depletion_fraction"):
        one = by_name[name]
        assert one.low <= true_value(name) <= one.high, one
    assert by_name["field_capacity"].value == pytest.approx(TWIN.field_capacity, rel=0.1)
    assert by_name["crop_coefficient"].value == pytest.approx(TWIN.crop_coefficient, rel=0.15)
    drainage = by_name["drainage_time"]
    assert not drainage.told
    assert drainage.words == "steps of 1 day are too long to tell it"
    assert drainage.value == found.site.drainage_time == ELSEWHERE.drainage_time


def test_few_sums_tell_few_parameters(tmp_path: Path) -> None:
    """Of twelve days' runoff there are four sums of four days at most, and of the roof five
    parameters that could be fitted.
    """
    rows = summed(record_rows(TWIN, 110, 1, gaps=False), 24)
    record = read_csv_record(write(rows, tmp_path / "days.csv"), TWIN)
    found = fit(ELSEWHERE, replace(record, level=None), np.arange(record.steps) < 12)
    assert sum(one.told for one in found.parameters) <= 4
    assert all(one.words for one in found.parameters if not one.told)


def test_a_fit_says_how_far_it_is(record: Record) -> None:
    """Each stage in turn; the share grows with each simulation, and ends at 1."""
    told: list[tuple[str, float]] = []
    fit(ELSEWHERE, record, record.known, lambda text, share: told.append((text, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert (shares[0], told[-1]) == (0.0, ("done", 1.0))
    stages = [re.match(r"(\d) of 5: (.*), \d+ simulations", text) for text, _ in told[:-1]]
    assert list(dict.fromkeys(stage[1] for stage in stages)) == ["1", "2", "3", "4", "5"]
    # One for each parameter and one before; then the start and a grid of 3 x 4 x 2.
    assert sum(stage[1] == "1" for stage in stages) == 1 + 7
    assert sum(stage[1] == "2" for stage in stages) == 1 + 25
    assert f"last search, {len(told) - 1 - 5} simulations" in told[-2][0]


def test_a_dead_day_of_a_sensor_does_not_decide(record: Record) -> None:
    """A level that reads 8 cm too much for a day, among sixty: the loss is robust."""
    level = record.level.copy()
    level[20 * 288:21 * 288] += 0.08
    found = fit(ELSEWHERE, replace(record, level=level), record.known)
    field_capacity = next(one for one in found.parameters if one.name == "field_capacity")
    assert field_capacity.value == pytest.approx(TWIN.field_capacity, rel=0.03)


def test_the_interval_of_a_mean_is_that_of_students_t() -> None:
    """The jackknife of a mean is its standard error, s / sqrt(n) (Efron 1982, chapter 3).

    One group says nothing.
    """
    values = np.array([2.0, 3.5, 1.0, 4.0, 2.5, 6.0])
    count = len(values)
    moved = moves(np.ones((count, 1)), values.mean() - values, np.arange(count))
    expected = student.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count)
    assert half_intervals(moved) == pytest.approx([expected])
    alone = moves(np.ones((3, 1)), np.array([1.0, -2.0, 1.0]), np.zeros(3, dtype=np.int64))
    assert half_intervals(alone).tolist() == [np.inf]
