"""Ensembles of forecasts: who is in one group when, and what is waited for."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from paper import lookahead

from greenroof_ros.controllers.scenario_tree import halved_by_rain
from greenroof_ros.model.look_ahead import growing_steps


def test_the_drier_half_parts_from_the_wetter() -> None:
    """Five members, hours of rain (mm), a halving every two hours: worked out by hand.

    After two hours 0, 1, 1, 2 and 3 mm have fallen: the two driest part. The second 1 mm is wetter
    than the first since more of it comes in the next hour. After four hours each is alone but the
    two wettest, and after six these, too.
    """
    fallen = [[2, 0, 0, 5, 0, 0, 0, 0], [0, 1, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 9, 0, 0, 0],
              [3, 0, 0, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0, 0, 0]]
    groups = halved_by_rain(np.array(fallen, dtype=float), np.arange(9) * 3600.0, 7200.0)
    assert groups.T.tolist() == (
        [[0, 0, 0, 0, 0]] * 2 + [[0, 0, 2, 0, 2]] * 2 + [[0, 1, 2, 0, 4]] * 2
        + [[0, 1, 2, 3, 4]] * 2
    )


@given(st.integers(1, 12), st.floats(1.0, 300.0), st.integers(0, 2**32))
def test_members_part_and_never_meet_again(members: int, recourse: float, seed: int) -> None:
    """All are one group until recourse; those known apart stay apart; in any order of members."""
    edges = growing_steps(240)
    chance = np.random.default_rng(seed)
    rain = np.maximum(0.0, chance.normal(-1, 1, (members, len(edges) - 1)))
    groups = halved_by_rain(rain, edges, recourse * 3600)
    assert not groups[:, edges[:-1] < recourse * 3600].any()
    together = groups[:, None] == groups[None]
    assert (together[..., 1:] <= together[..., :-1]).all()
    assert (groups == together.argmax(axis=1)).all()  # named after the first of them
    halvings = math.ceil(math.log2(members)) if members > 1 else 0
    assert together[..., -1].sum() == members or halvings * recourse > 234
    order = chance.permutation(members)
    again = halved_by_rain(rain[order], edges, recourse * 3600)
    assert ((again[:, None] == again[None]) == together[np.ix_(order, order)]).all()


def test_it_waits_for_what_will_be_known_in_time() -> None:
    """Rain in six hours that one member of eight has, and that fills the roof for a day.

    Known apart from most of the others after an hour it is worth the hour. Not known apart before
    it falls the roof is filled: seven of eight lack water.
    """
    edges = growing_steps(12)
    storm = np.where((edges[:-1] >= 21_600) & (edges[:-1] < 32_400), 3e-6, 0.0)
    rain = np.stack([*[0 * storm] * 7, storm])
    commands = [
        lookahead(recourse=hours, days_after=1).command(2.3, 0.04, rain, [0.0] * len(storm))
        for hours in (1.0, 240.0)
    ]
    assert commands[0] == 0.0
    assert commands[1] > 0.9
