"""A valve that is either open or closed, against its rule."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from greenroof_ros.physics.storm_water import make_valve, move_valve

SHARES = st.sampled_from([0.0, 0.4999, 0.5, 1.0, math.nan]) | st.floats(0, 1)


@given(
    moves=st.sampled_from([2, 3, 4, 60, 3600]) | st.floats(2, 3600),
    seconds=st.sampled_from([0.1, 1.0, 60.0, 300.0, 3600.0]), gap=st.sampled_from([1, 7, 100]),
    commands=st.lists(SHARES, min_size=1, max_size=200),
)
def test_it_closes_at_once_and_opens_when_due(
    moves: float, seconds: float, gap: int, commands: list[float]
) -> None:
    """Each command holds for some ticks. No hour has more moves than the maximum."""
    valve, wants = [*make_valve(moves)], [c >= 0.5 for c in commands for _ in range(gap)]
    found = [move_valve(valve, seconds, command) for command in commands for _ in range(gap)]
    closed = -math.inf
    for k, (before, opening, wanted) in enumerate(zip([0.0, *found], found, wants, strict=False)):
        # Just when it is due, rounding decides.
        rested = (k - closed) * seconds / (7200 / moves)
        if not wanted or before == 1 or abs(rested - 1) > 1e-6:
            assert opening == float(wanted and (before == 1 or rested >= 1))
        closed = k if opening < before else closed
    moved = [k * seconds for k in range(len(found)) if found[k] != [0.0, *found][k]]
    for start in moved:
        assert sum(start <= each < start + 3600 - 0.01 for each in moved) <= math.ceil(moves)


@pytest.mark.parametrize(
    ("moves", "seconds", "ticks"), [(4, 0.1, 18_000), (4, 420.0, 5), (7, 1, 1029)]
)
def test_it_opens_again_in_the_first_tick_that_is_due(
    moves: float, seconds: float, ticks: int
) -> None:
    """1800 s or 1028.6 s after it last closed, however long it was open."""
    valve = [*make_valve(moves)]
    commands = [*[1.0] * 9, *[0.0] * (ticks - 1), 1.0, 1.0]
    assert [move_valve(valve, seconds, each) for each in commands][-2:] == [0.0, 1.0]


def test_without_a_limit_it_follows_every_command() -> None:
    valve = [*make_valve(None)]
    assert [move_valve(valve, 1.0, share) for share in (0.0, 0.3, 1.0, 0.7)] == [0.0, 0.3, 1.0, 0.7]
