"""What is most likely wrong with forecasts: leads that lack water, rain of another place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from greenroof_ros.analysis.verification.checks import check_forecasts
from greenroof_ros.analysis.verification.pairs import Class, Sum
from greenroof_ros.analysis.verification.scores import Tally


def cases(
    hours: int, shares: Sequence[float], *, known: bool = True, previous_runs: bool = True
) -> list[str]:
    """Return the warnings about days of forecasts, each with its share of the water that fell."""
    rng = np.random.default_rng(7)
    fell, elsewhere = rng.gamma(0.5, 2.0, (2, hours)) * (rng.random((2, hours)) < 0.06)
    tallies = {}
    for day, share in enumerate(shares):
        tally = Tally(1.0)
        tally.add(share * (fell if known else elsewhere)[None], fell)
        tallies[Class(24 * day, 24 * day + 24, Sum(1, 1.0))] = tally
    return check_forecasts(tallies, previous_runs=previous_runs)


@pytest.mark.parametrize(
    ("hours", "shares", "odd"),
    [
        (8900, (1.0, 1.1, 0.9, 1.0, 0.45), 0.45), (8900, (1.0, 1.1, 0.9, 1.0, 2.5), 2.5),
        (8900, (1.0, 1.1, 0.9, 1.0, 0.7), None), (4000, (1.0, 1.1, 0.9, 1.0, 0.45), None),
        (8900, (1.0, 0.4), None),
    ],
)
def test_a_day_without_half_of_its_water(
    hours: int, shares: Sequence[float], odd: float | None
) -> None:
    """It is named, like GFS's fifth day, with its ratio to the median of the others, 1.

    Not named: what storms can do, less than a year, one of only two days.
    """
    warnings = cases(hours, shares)
    assert len(warnings) == (odd is not None)
    for warning in warnings:
        assert warning.startswith("day 5 contains ")
        assert float(warning.split()[3]) == pytest.approx(odd, abs=0.01)
    assert cases(hours, shares, previous_runs=False) == []


@pytest.mark.parametrize(("pairs", "named"), [(1300, True), (900, False)])
def test_forecasts_that_know_nothing(pairs: int, named: bool) -> None:
    """Less than 1000 pairs tell nothing."""
    assert len(cases(pairs, (1.0,), known=False)) == named
    assert cases(pairs, (1.0,)) == []
