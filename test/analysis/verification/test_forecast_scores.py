"""Scores: worked examples, closed forms, and other ways of computing them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from greenroof_ros.analysis.verification import crps, score_pairs

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
    """From pairs, one for each case in the table; an event begins at its amount."""
    pairs = np.repeat([(3.0, 3.0), (3.0, 2.9), (2.9, 3.0), (2.9, 2.9)], table, axis=0)
    scores = score_pairs(pairs[None, :, 0], pairs[:, 1], 3.0)
    assert scores["n"] == sum(table)
    found = scores["pod"], scores["far"], scores["ets"]
    assert found == pytest.approx((pod, far, ets), abs=digits)
    # For a forecast without doubt, the share of errors.
    assert scores["brier"] == pytest.approx((table[1] + table[2]) / sum(table))


def test_moments_and_missing() -> None:
    """Correlation as scipy's, bias as the ratio of totals; pairs with NaN do not count."""
    chance = np.random.default_rng(1)
    forecast, observed = chance.gamma(0.2, 5.0, (2, 502))
    observed += 0.5 * forecast
    known = slice(2, None)
    scores = score_pairs(
        np.array([[np.nan, 1.0, *forecast[known]]]), np.array([1.0, np.nan, *observed[known]]), 5.0
    )
    forecast, observed = forecast[known], observed[known]
    assert scores["n"] == 500
    assert scores["r"] == pytest.approx(stats.pearsonr(forecast, observed).statistic, rel=1e-10)
    assert scores["bias"] == pytest.approx(forecast.sum() / observed.sum())
    assert scores["crps_mm"] == pytest.approx(np.abs(forecast - observed).mean())


def test_nothing_to_be_scored() -> None:
    """No pairs, no rain, no events: exactly the undefined scores are NaN."""
    n, *others = score_pairs(np.zeros((1, 0)), np.zeros(0), 5.0).values()
    assert n == 0 and all(map(math.isnan, others))
    n, *undefined, brier, error = score_pairs(np.zeros((1, 7)), np.zeros(7), 5.0).values()
    assert (n, brier, error) == (7, 0.0, 0.0) and all(map(math.isnan, undefined))
    # A constant without an exact binary value is still a constant.
    assert math.isnan(score_pairs(np.full((1, 1000), 0.1), np.linspace(0, 9, 1000), 5.0)["r"])


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
    forecast = np.array([[2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    scores = score_pairs(forecast, np.array([5.0, 0.0, 1.0]), 1.0)
    assert scores["brier"] == pytest.approx(13 / 24)
