"""Scores: worked examples, closed forms, and other ways of computing them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from greenroof_ros.analysis.verification.scores import Tally, crps

# Finley's tornado forecasts of 1884 in Wilks (2011, Sect. 8.2), with 28 hits, 72 false alarms and
# 23 misses; also www.cawcr.gov.au/projects/verification/Finley. And the rain of the WWRP working
# group's "Forecast Verification - Issues, Methods and FAQ": POD 0.78, FAR 0.32, ETS 0.44.
EXAMPLES = [
    ((28, 72, 23, 2680), 0.549, 0.720, 0.216, 5e-4),
    ((82, 38, 23, 222), 0.78, 0.32, 0.44, 5e-3),
]


@pytest.mark.parametrize(("table", "pod", "far", "ets", "digits"), EXAMPLES)
def test_events(
    table: tuple[int, int, int, int], pod: float, far: float, ets: float, digits: float
) -> None:
    """From pairs, one for each case in the table."""
    cases = [(9.0, 9.0), (9.0, 0.0), (0.0, 9.0), (0.0, 0.0)]
    pairs = np.repeat(np.array(cases), table, axis=0)
    tally = Tally(3.0)
    tally.add(pairs[None, :1000, 0], pairs[:1000, 1])
    tally.add(pairs[None, 1000:, 0], pairs[1000:, 1])
    assert tally.table.tolist() == list(table)
    scores = tally.scores()
    assert scores.n == sum(table)
    assert (scores.pod, scores.far, scores.ets) == pytest.approx((pod, far, ets), abs=digits)
    # For a forecast without doubt, the share of errors.
    assert scores.brier == pytest.approx((table[1] + table[2]) / sum(table))


def test_an_event_begins_at_its_amount() -> None:
    """For both the forecast and the observation."""
    tally = Tally(3.0)
    tally.add(np.array([[3.0, 3.0, 2.9, 2.9]]), np.array([3.0, 2.9, 3.0, 2.9]))
    assert tally.table.tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize("members", [1, 10])
def test_moments_and_missing(members: int) -> None:
    """Correlation as scipy's, bias as the ratio of totals; pairs with NaN do not count."""
    chance = np.random.default_rng(members)
    forecast = chance.gamma(0.2, 5.0, (members, 500))
    observed = 0.5 * forecast[0] + chance.gamma(0.2, 5.0, 500)
    tally = Tally(5.0)
    for low, high in ((0, 100), (100, 101), (101, 500)):
        tally.add(forecast[:, low:high], observed[low:high])
    holes = np.array([1.0, np.nan])
    tally.add(np.full((members, 2), [np.nan, 1.0]), holes)
    scores = tally.scores()
    assert scores.n == 500
    assert scores.r == pytest.approx(stats.pearsonr(forecast[0], observed).statistic, rel=1e-10)
    assert scores.bias == pytest.approx(forecast[0].sum() / observed.sum())
    if members == 1:
        assert scores.crps == pytest.approx(np.abs(forecast[0] - observed).mean())


def test_nothing_to_be_scored() -> None:
    """No pairs, no rain, no events: exactly the undefined scores are NaN."""
    tally = Tally(5.0)
    assert tally.scores().n == 0 and all(map(math.isnan, tally.scores()[1:]))
    tally.add(np.zeros((1, 7)), np.zeros(7))
    scores = tally.scores()
    assert (scores.n, scores.brier, scores.crps) == (7, 0.0, 0.0)
    assert all(map(math.isnan, scores[1:6]))
    # A constant without an exact binary value is still a constant.
    tally = Tally(5.0)
    tally.add(np.full((1, 1000), 0.1), np.linspace(0, 9, 1000))
    assert math.isnan(tally.scores().r)


# --- CRPS --------------------------------------------------------------------------------------


@given(
    members=st.lists(st.floats(0, 50), min_size=1, max_size=8), observed=st.floats(0, 50),
)
def test_crps_is_the_integral_made_fair(members: list[float], observed: float) -> None:
    """The squared difference of two distributions, piece by piece between their steps.

    The excess of M members is subtracted: half of the mean of |x_i - x_j| over all i and j,
    over M - 1 (Ferro 2014).
    """
    steps = sorted([*members, observed])
    count = len(members)
    expected = math.fsum(
        (high - low) * (sum(member <= low for member in members) / count - (observed <= low)) ** 2
        for low, high in itertools.pairwise(steps)
    )
    if count > 1:
        apart = math.fsum(abs(a - b) for a, b in itertools.product(members, members))
        expected -= apart / (2 * count**2 * (count - 1))
    got = crps(np.array(members)[:, None], np.array([observed]))
    assert got.tolist() == pytest.approx([expected], rel=1e-9, abs=1e-9)


def test_briers_score_by_hand() -> None:
    """Four members, of which three, three and none forecast the event: 1/16, 9/16 and 1."""
    tally = Tally(1.0)
    forecast = np.array([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    tally.add(forecast, np.array([5.0, 0.0, 1.0]))
    assert tally.scores().brier == pytest.approx(13 / 24)
