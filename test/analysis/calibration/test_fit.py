"""The fit finds the roof that made a record, and reports what it cannot find."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import t as student
from twins import DAY, FILLED_AT_FIRST, TWIN, record_of, record_rows

from greenroof_ros.analysis.calibration.fit import (
    Fit,
    choose_exponent,
    compute_intervals,
    fit,
    fit_exponents,
    list_ranges,
)
from greenroof_ros.analysis.calibration.record import FitScores, StepRecord, halve_steps
from greenroof_ros.site.site import Site

ELSEWHERE = replace(
    TWIN, field_capacity=0.3, z_cap=3.0, wilting_point=0.02, depletion_fraction=0.5,
    drainage_time=300.0, crop_coefficient=1.0,
)
"""the site at which the fit starts"""


def fit_all(record: StepRecord, site: Site = ELSEWHERE) -> Fit:
    """Return the fit to a whole record."""
    every = record.complete
    return fit(site, record, {"fit": every, "validation": every})


def values_of(fitted: Fit) -> dict[str, float]:
    """Return the values that the record identifies; each interval must contain the truth."""
    known = [parameter for parameter in fitted.parameters if parameter.interval]
    for parameter in known:
        assert parameter.low <= getattr(TWIN, parameter.name) <= parameter.high, parameter
    return {parameter.name: parameter.value for parameter in known}


def without(record: StepRecord, name: str) -> StepRecord:
    """Return a record in which a quantity was not measured."""
    return replace(record, measured={
        other: series for other, series in record.measured.items() if other != name
    })


@cache
def twin(hours: int, days: int, seed: int = 2) -> StepRecord:
    """Return a record with a noise of 2 mm and steps of this many hours; 0 means five minutes."""
    return record_of(record_rows(TWIN, 150, seed, gaps=False)[:1 + days * DAY], hours)


def test_a_twin_is_recovered() -> None:
    """From six weeks."""
    fitted = fit_all(twin(0, 45))
    values = values_of(fitted)
    assert values.keys() == {
        "field_capacity", "wilting_point", "depletion_fraction", "drainage_time",
        "crop_coefficient",
    }
    for name, value in values.items():
        assert value == pytest.approx(getattr(TWIN, name), rel=0.05), name
    assert fitted.filled == pytest.approx(FILLED_AT_FIRST, rel=0.05)


def test_runoff_alone_tells_only_what_the_soil_holds_between() -> None:
    """Only the difference of field capacity and wilting point matters; the level separates them.

    So the interval of the field capacity allows for any wilting point, including the true one.
    """
    record = without(twin(1, 100), "level")
    by_name = {parameter.name: parameter for parameter in fit_all(record).parameters}
    assert by_name["wilting_point"].reason == "the record does not determine it"
    assert not by_name["wilting_point"].interval
    assert by_name["wilting_point"].value == pytest.approx(0.02)
    true = TWIN.field_capacity - TWIN.wilting_point
    capacity = by_name["field_capacity"]
    assert capacity.value - 0.02 == pytest.approx(true, rel=0.05)
    assert capacity.low < TWIN.field_capacity < capacity.high
    highest = {span.name: span for span in list_ranges(ELSEWHERE, record)}["wilting_point"].high
    assert capacity.high - capacity.value == pytest.approx(highest - 0.02, rel=0.15)


def test_levels_alone_tell_nothing_of_the_drainage_layer() -> None:
    by_name = {row.name: row for row in fit_all(without(twin(1, 100), "runoff")).parameters}
    assert not by_name["drainage_time"].interval
    assert by_name["drainage_time"].value == pytest.approx(300.0)
    assert by_name["field_capacity"].value == pytest.approx(TWIN.field_capacity, rel=0.03)


def test_a_dead_day_of_a_sensor_does_not_decide() -> None:
    """A level that reads 8 cm too high for one day in 100: the loss is robust."""
    record = twin(1, 100)
    level = record.measured["level"].copy()
    level[20 * 24:21 * 24] += 0.08
    fitted = fit_all(replace(record, measured={**record.measured, "level": level}))
    assert fitted.site.field_capacity == pytest.approx(TWIN.field_capacity, rel=0.03)


def test_longer_steps_do_not_make_more_runoff() -> None:
    """150 days, with the true drainage time in the site file; six-hour steps do not fit it.

    In a simulated step rain falls evenly, and so runs off late. Fitted step by step, these
    six-hour records would make up for that by 15 % more runoff.
    """
    record = twin(6, 150)
    fitted = fit_all(record, replace(ELSEWHERE, drainage_time=TWIN.drainage_time))
    values = values_of(fitted)
    assert values["field_capacity"] == pytest.approx(TWIN.field_capacity, rel=0.02)
    assert values["crop_coefficient"] == pytest.approx(TWIN.crop_coefficient, rel=0.05)
    assert "drainage_time" not in values
    assert fitted.scores[0].volume_error == pytest.approx(0.0, abs=0.02)


def test_of_daily_sums_the_soil_is_found() -> None:
    """110 daily sums and morning levels; they cannot show how fast the roof drains.

    Twelve days of runoff give at most four sums of four days, but the roof has five parameters
    that could be fitted.
    """
    record = twin(24, 110, seed=1)
    fitted = fit_all(record)
    values = values_of(fitted)
    assert {"wilting_point", "depletion_fraction"} <= values.keys()
    assert values["field_capacity"] == pytest.approx(TWIN.field_capacity, rel=0.1)
    assert values["crop_coefficient"] == pytest.approx(TWIN.crop_coefficient, rel=0.15)
    assert fitted.site.drainage_time == ELSEWHERE.drainage_time
    few = {name: getattr(record, name)[:12] for name in ("rain", "reference", "pumped")}
    fitted = fit_all(replace(record, **few, measured={"runoff": record.measured["runoff"][:12]}))
    assert len(values_of(fitted)) <= 4
    assert all(row.reason for row in fitted.parameters if not row.interval)


@pytest.mark.parametrize("true", [1.0, 5.0])
def test_the_exponent_of_a_twin_is_found(true: float) -> None:
    """In the half that was not fitted, from a site with another one."""
    roof = replace(TWIN, percolation_exponent=true)
    rows = record_rows(roof, 150, 2, gaps=False)[:1 + 120 * DAY]
    record = without(record_of(rows, 1), "level")
    halves = halve_steps(record, record.complete)
    fits = fit_exponents(TWIN, record, halves, exponents=[1.0, 2.0, 5.0])
    fitted, note = choose_exponent(fits, 2.0)
    exponent = fitted.parameters[-1]
    assert exponent.low <= exponent.value == true <= exponent.high
    assert not exponent.low <= 2.0 <= exponent.high
    assert fitted.site.percolation_exponent == true
    assert fitted.site.available_volume == pytest.approx(TWIN.available_volume, rel=0.1)
    assert max(each.nse for each in fits) > 0.9 and f"with {true:g}" in note


def test_an_exponent_that_is_not_told_apart_is_kept() -> None:
    """Within 0.05 of the best NSE, which is interpolated; otherwise the best is used."""
    fits = [
        Fit(
            replace(TWIN, percolation_exponent=exponent), [], 0.5, {},
            [FitScores("runoff", "validation", {60: 0.0, 3600: nse, 86400: 1.0}, 0.0)],
        ) for exponent, nse in ((1.0, 0.70), (1.5, 0.79), (2.0, 0.80), (3.0, 0.76), (5.0, 0.5))
    ]
    for own, used in ((3.0, 3.0), (1.5, 1.5), (1.0, 2.0), (5.0, 2.0)):
        fitted, _ = choose_exponent(fits, own)
        (exponent,) = fitted.parameters
        assert exponent[1:4] == pytest.approx((used, 1 + 0.5 * 5 / 9, 5 - 2 * 25 / 26))
        assert fitted.site.percolation_exponent == used
    fitted, _ = choose_exponent(fits[2:3], 2.0)
    assert fitted.parameters[0][1:4] == (2.0, 2.0, 2.0)


def test_a_mean_has_the_interval_of_students_t() -> None:
    """The jackknife of a mean is its standard error, s / sqrt(n) (Efron 1982, chapter 3)."""
    values = np.array([2.0, 3.5, 1.0, 4.0, 2.5, 6.0])
    count = len(values)
    half = compute_intervals(np.ones((count, 1)), values.mean() - values, np.arange(count))
    expected = student.ppf(0.975, count - 1) * values.std(ddof=1) / np.sqrt(count)
    assert half == pytest.approx([expected])


def test_intervals_hold_the_truth_however_few_weeks_have_storms() -> None:
    """In 19 of 20 seeded records of 26 weeks; the residuals of other weeks tell hardly anything.

    With 25 degrees of freedom it would be less than 18 with three storms.
    """
    random = np.random.default_rng(3)
    groups = np.repeat(np.arange(26), 4)
    size = np.where(groups < 3, 1.0, 0.02)
    held, trials = 0, 600
    for _ in range(trials):
        jacobian = size[:, None] * random.normal(size=(len(groups), 2))
        noise = random.normal(size=len(groups))
        moved = np.linalg.lstsq(jacobian, noise, rcond=None)[0]  # the truth is 0
        half = compute_intervals(jacobian, jacobian @ moved - noise, groups)
        held += int(abs(moved[0]) <= half[0])
    assert held / trials > 0.93  # three standard errors below 0.95 are 0.923


def test_a_parameter_that_one_week_alone_tells_has_no_interval() -> None:
    """Without that week nothing is left; the others have theirs."""
    jacobian = np.array([[1.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.5, 1.0]])
    groups = np.array([0, 1, 2, 3, 0])
    half = compute_intervals(jacobian, np.array([0.1, -0.1, 0.2, -0.2, 0.0]), groups)
    assert half[0] == np.inf and 0 < half[1] < np.inf
    half = compute_intervals(jacobian[:2], np.zeros(2), groups[[0, 0]])
    assert half.tolist() == [np.inf, np.inf]

