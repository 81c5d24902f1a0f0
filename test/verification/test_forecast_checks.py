"""What is most likely wrong with forecasts: leads that lack water, rain of another place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from greenroof_ros.verification.checks import check_forecasts
from greenroof_ros.verification.pairs import Class, Sum
from greenroof_ros.verification.scores import Tally


def cases(
    hours: int, shares: Sequence[float], *, known: bool = True, previous_runs: bool = True
) -> list[tuple[str, dict[str, float | str]]]:
    """What is found in days of forecasts, each with its share of the water that fell."""
    rng = np.random.default_rng(7)
    fell, elsewhere = rng.gamma(0.5, 2.0, (2, hours)) * (rng.random((2, hours)) < 0.06)
    tallies = {}
    for day, share in enumerate(shares):
        tally = Tally(1.0, 1)
        tally.add(share * (fell if known else elsewhere)[None], fell)
        tallies[Class(24 * day, 24 * day + 24, Sum(1, 1.0))] = tally
    findings = check_forecasts(tallies, previous_runs=previous_runs)
    assert all(one.severity.value == "warning" for one in findings)
    return [(one.code, dict(one.figures)) for one in findings]


@pytest.mark.parametrize(
    ("hours", "last", "odd"),
    [(8900, 0.45, True), (8900, 2.5, True), (8900, 0.7, False), (4000, 0.45, False)],
)
def test_a_day_without_half_of_its_water(hours: int, last: float, odd: bool) -> None:
    """It is named, as GFS's fifth would be; what storms may do is not, nor less than a year.

    The ratio is that to the median of the others, 1.
    """
    found = cases(hours, (1.0, 1.1, 0.9, 1.0, last))
    assert [code for code, _ in found] == ["odd-lead"] * odd
    if odd:
        assert found[0][1] == {"lead": "day 5", "ratio": pytest.approx(last, abs=0.01)}
    assert cases(hours, (1.0, 1.1, 0.9, 1.0, last), previous_runs=False) == []


def test_two_leads_do_not_say_which_is_odd() -> None:
    assert cases(8900, (1.0, 0.4)) == []


@pytest.mark.parametrize(("pairs", "named"), [(1300, True), (900, False)])
def test_forecasts_that_know_nothing(pairs: int, named: bool) -> None:
    """Less than 1000 pairs tell nothing."""
    codes = [code for code, _ in cases(pairs, (1.0,), known=False)]
    assert codes == ["unrelated"] * named
    assert cases(pairs, (1.0,)) == []
