"""Ensembles of forecasts: who is in one group when, and the program over the tree of groups."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from paper import PAPER_SITE, planner, site_with
from scipy.optimize import linprog

from greenroof_ros.controllers.exact_program import ExactProgram
from greenroof_ros.controllers.objective import NO_PRICES
from greenroof_ros.controllers.planning_program import PlanningProgram
from greenroof_ros.controllers.scenario_tree import Groups, halved_by_rain, means_of_groups
from greenroof_ros.model.look_ahead import growing_steps
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

Array = NDArray[np.float64]

FULL = maximum_pump_flow(PAPER_SITE, 57.0)
MAX_COMMAND = 0.01


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


def drawn(seed: int, members: int, horizon: float) -> tuple[Array, Array, Array, Array, float]:
    """Return edges, mean and most of a program, its rain (m/s), and when members part (s)."""
    edges = growing_steps(horizon)
    lengths, steps = np.diff(edges), len(edges) - 1
    chance = np.random.default_rng(seed)
    rain = chance.choice([0.0, 4e-8, 4e-7, 4e-6], (members, steps), p=[0.6, 0.3, 0.07, 0.03])
    # The members part from a common beginning.
    rain[:, : steps // 3] = rain[0, : steps // 3]
    changes = lengths * (rain * PAPER_SITE.a2 - 4e-6)
    course = chance.uniform(-2.4, 1.0) + np.cumsum(changes, axis=1) - changes / 2
    most = np.maximum.accumulate(np.maximum(-course, 0.0), axis=1)
    most = np.minimum(most, chance.uniform(0, 6, (members, 1)))
    return edges, course, most, rain, float(chance.uniform(0.05, 0.5) * edges[-1])


def extensive_form(
    mean: Array, most: Array, groups: Groups, lengths: Array, able: Array, counting: list[Array],
    limited: list[Array],
) -> float:
    """Return the least sum of deviations by HiGHS, with a volume for each member and step.

    Those of a group are equal by a constraint for each pair. Matrices of each member make of its
    volumes those that count for the deviation, and those that are limited, shape (n, n).
    """
    members, n = mean.shape
    size = members * n
    eye = scipy.sparse.identity(size)
    counts, limits = (scipy.sparse.block_diag(each) for each in (counting, limited))
    rise = scipy.sparse.kron(
        scipy.sparse.identity(members), np.eye(n) - np.eye(n, k=-1)
    )
    none = scipy.sparse.csr_matrix((size, size))
    equal = []
    for one in range(members):
        for step in np.flatnonzero(groups[one] != one):
            row = np.zeros(2 * size)
            row[one * n + step], row[groups[one, step] * n + step] = 1, -1
            equal.append(row)
    result = linprog(
        np.concatenate([np.zeros(size), np.tile(lengths, members)]),
        A_ub=scipy.sparse.bmat(
            [[counts, -eye], [-counts, -eye], [rise, none], [-rise, none], [limits, none]]
        ),
        b_ub=np.concatenate(
            [-mean.ravel(), mean.ravel(), np.tile(able, members), np.zeros(size), most.ravel()]
        ),
        A_eq=np.array(equal) if equal else None,
        b_eq=np.zeros(len(equal)) if equal else None,
        bounds=(0, None),
        method="highs",
    )
    assert result.status == 0
    return float(result.fun)


@given(
    st.integers(1, 6), st.sampled_from([1.0, 12.0]), st.sampled_from([0.0, 0.1]),
    st.integers(0, 2**32),
)
def test_exact_program_against_the_extensive_form(
    members: int, horizon: float, fading: float, seed: int
) -> None:
    """The least possible; each member's plan is within its bound, and that of its group.

    Of what was pumped in a step its share over that of the step is left later, in a group the mean
    of its members' shares.
    """
    edges, mean, most, rain, recourse = drawn(seed, members, horizon)
    groups = halved_by_rain(rain, edges, recourse)
    lengths, steps = np.diff(edges), len(edges) - 1
    chance = np.random.default_rng(seed)
    lasting = np.exp(-np.cumsum(chance.uniform(0, 2 * fading, mean.shape), axis=1))
    one = ExactProgram(edges, MAX_COMMAND)
    plans = one.solve(
        mean, most, FULL, 0.0, None, groups, lasting=lasting if fading else None
    )
    able = MAX_COMMAND * FULL * np.diff(edges[:-1] + lengths / 2, prepend=0.0)
    of_group = [
        [lasting[groups[:, step] == groups[member, step], step].mean() for step in range(steps)]
        for member in range(members)
    ]
    left = [
        np.outer(share, 1 / np.array(share)) * np.tri(steps) @ (np.eye(steps) - np.eye(steps, k=-1))
        for share in of_group
    ]
    best = extensive_form(mean, most, groups, lengths, able, left, left)
    assert one.cost == pytest.approx(best / edges[-1] / members, rel=1e-6, abs=1e-9)
    assert np.diff(plans, prepend=0.0, axis=1).min() >= 0
    assert (plans <= most / np.array(of_group) * (1 + 1e-12)).all()
    # Not told apart in the next step either: not a bit of difference.
    same = groups[:, None, 1:] == groups[None, :, 1:]
    assert (plans[:, None, :-1] == plans[None, :, :-1])[same].all()


@given(st.integers(2, 8), st.integers(0, 2**32))
def test_the_order_of_members_does_not_matter(members: int, seed: int) -> None:
    """Each has its plan wherever it stands, bit for bit."""
    edges, mean, most, rain, recourse = drawn(seed, members, 24.0)
    order = np.random.default_rng(seed).permutation(members)
    plans = [
        ExactProgram(edges, MAX_COMMAND).solve(
            mean[each], most[each], FULL, 0.0, None, halved_by_rain(rain[each], edges, recourse)
        )
        for each in (np.arange(members), order)
    ]
    assert plans[1].tobytes() == plans[0][order].tobytes()


@given(st.integers(1, 12), st.integers(0, 2**32))
def test_the_mean_of_a_group_is_its_members(members: int, seed: int) -> None:
    """Whatever their order, bit for bit, and for equal members the value itself."""
    edges, _, _, rain, recourse = drawn(seed, members, 24.0)
    groups = halved_by_rain(rain, edges, recourse)
    chance = np.random.default_rng(seed)
    values, order = chance.uniform(0, 1, rain.shape), chance.permutation(members)
    means = means_of_groups(values, groups)
    for step in range(len(edges) - 1):
        for member in range(members):
            alike = groups[:, step] == groups[member, step]
            assert means[member, step] == pytest.approx(values[alike, step].mean(), rel=1e-12)
    again = means_of_groups(values[order], halved_by_rain(rain[order], edges, recourse))
    assert again.tobytes() == means[order].tobytes()
    equal = np.broadcast_to(values[:1], values.shape)
    assert (means_of_groups(equal, groups) == equal).all()


@given(st.integers(2, 20), st.integers(0, 2**32))
def test_members_that_agree_are_one_forecast(members: int, seed: int) -> None:
    """The plan of planning_mpc, bit for bit, in whichever groups they are."""
    edges, mean, most, _, recourse = drawn(seed, 1, 24.0)
    one = ExactProgram(edges, MAX_COMMAND)
    (alone,) = one.solve(mean, most, FULL, 0.0, None, np.zeros(mean.shape, dtype=np.intp))
    rain = np.random.default_rng(seed).uniform(0, 1, (members, len(edges) - 1))
    plans = one.solve(
        np.repeat(mean, members, axis=0), np.repeat(most, members, axis=0), FULL, 0.0, None,
        halved_by_rain(rain, edges, recourse),
    )
    assert all(plan.tobytes() == alone.tobytes() for plan in plans)


def test_the_solvers_program_against_the_extensive_form() -> None:
    """That for prices and low outlets, here without them: within 0.1 % and 0.1 mm.

    Volumes of a group are alike to the solver's tolerance.
    """
    for seed in range(4):
        edges, mean, most, rain, recourse = drawn(seed, 4, 12.0)
        groups = halved_by_rain(rain, edges, recourse)
        lengths, steps = np.diff(edges), len(edges) - 1
        one = PlanningProgram(PAPER_SITE, edges, MAX_COMMAND, 1.0, NO_PRICES, 20000)
        plans = one.solve(mean, most, FULL, 0.0, None, groups)
        assert plans is not None
        between = (np.eye(steps) + np.eye(steps, k=-1)) / 2
        best = extensive_form(
            mean, most, groups, lengths, MAX_COMMAND * FULL * lengths, [between] * 4,
            [np.eye(steps)] * 4,
        )
        reached = (lengths * np.abs(mean + plans @ between.T)).sum()
        assert reached / edges[-1] / 4 <= best / edges[-1] / 4 * 1.001 + 1e-4 * PAPER_SITE.a2
        for member in range(4):
            assert plans[member] == pytest.approx(
                np.take_along_axis(plans, groups[[member]], axis=0)[0], abs=0.01
            )


@pytest.mark.parametrize("site", [PAPER_SITE, site_with(low_outlet_level=0.5)])
def test_it_waits_for_what_will_be_known_in_time(site: Site) -> None:
    """Rain in six hours that one member of three has, and that fills the roof for days.

    Known apart from the others after an hour it is worth the hour. Not known apart before its end
    the roof is filled: two of three lack water.
    """
    edges = growing_steps(12)
    storm = np.where((edges[:-1] >= 21_600) & (edges[:-1] < 32_400), 3e-6, 0.0)
    rain = np.stack([0 * storm, 0 * storm, storm])
    commands = [
        planner(site, recourse=hours * 3600).command(2.3, 0.04, rain, [0.0] * len(storm))
        for hours in (1.0, 240.0)
    ]
    assert commands[0] == pytest.approx(0.0, abs=2e-3)
    assert commands[1] > 0.9
