"""The exponent of percolation, judged in the half of a record to which nothing was fitted."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from twins import DAY, TWIN, record_of, record_rows

from greenroof_ros.analysis.calibration.fit import Fit
from greenroof_ros.analysis.calibration.percolation import (
    ExponentFit,
    choose_exponent,
    fit_exponents,
)
from greenroof_ros.analysis.calibration.record import halve_steps
from greenroof_ros.analysis.calibration.simulation import Simulated
from greenroof_ros.analysis.calibration.step_record import StepRecord

NOTHING = Simulated(np.zeros(0), np.zeros(0))


@cache
def twin(exponent: float) -> StepRecord:
    """Return the runoff of 120 days, every hour, from a roof with an exponent."""
    rows = record_rows(replace(TWIN, percolation_exponent=exponent), 150, 2, gaps=False)
    return replace(record_of(rows[:1 + 120 * DAY], 1), level=None)


@pytest.mark.parametrize("true", [1.0, 5.0])
def test_the_exponent_of_a_twin_is_found(true: float) -> None:
    """From a site with another one; the progress of all fits grows to 1."""
    record, progress = twin(true), list[float]()
    halves = halve_steps(record, record.complete)
    fits = fit_exponents(
        TWIN, record, halves, lambda text, share: progress.append(share), [1.0, 2.0, 5.0]
    )
    fitted, note = choose_exponent(fits, 2.0)
    exponent = fitted.parameters[-1]
    assert exponent.name == "percolation_exponent"
    assert exponent.low <= exponent.value == true <= exponent.high
    assert not exponent.low <= 2.0 <= exponent.high
    assert fitted.site.percolation_exponent == true
    assert fitted.site.available_volume == pytest.approx(TWIN.available_volume, rel=0.1)
    assert max(each.nse for each in fits) > 0.9 and f"with {true:g}" in note
    assert progress == sorted(progress) and progress[-1] == 1.0


def test_an_exponent_that_is_not_told_apart_is_kept() -> None:
    """Within 0.05 of the best NSE, which is interpolated; otherwise the best is used."""
    fits = [
        ExponentFit(
            exponent, nse, Fit(replace(TWIN, percolation_exponent=exponent), [], NOTHING)
        ) for exponent, nse in ((1.0, 0.70), (1.5, 0.79), (2.0, 0.80), (3.0, 0.76), (5.0, 0.5))
    ]
    for own, used in ((3.0, 3.0), (1.5, 1.5), (1.0, 2.0), (5.0, 2.0)):
        fitted, _ = choose_exponent(fits, own)
        (exponent,) = fitted.parameters
        assert exponent[1:4] == pytest.approx((used, 1 + 0.5 * 5 / 9, 5 - 2 * 25 / 26))
        assert fitted.site.percolation_exponent == used
    fitted, _ = choose_exponent(fits[2:3], 2.0)
    assert fitted.parameters[0][1:4] == (2.0, 2.0, 2.0)
