"""The model predictive controller, compared with an exact solution of the paper's program."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper import PAPER_SITE, linear_model, paper_run, sites
from scipy.optimize import lsq_linear, nnls

from greenroof_ros.controllers import mpc as module
from greenroof_ros.controllers.mpc import Mpc
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site

# Weights, each with its run: one until the commands have been 0 for a while, one in a storm.
RUNS = {
    1e-5: ("--hours", "1.1"), 1e-3: ("--hours", "0.5"),
    1e-1: ("--hours", "0.25", "--start", "2021-07-08T05:00"),
}


@cache
def walk(weight: float, *options: str, max_command: float = math.inf) -> tuple[Any, Any, Any, Any]:
    """Run the controller with the exact plant, by default from low-low.

    Returns what it saw and did tick by tick: volumes (m3), shape (ticks, 2); forecast of w_r and
    w_e, shape (ticks, M, 2); commands; and its value of Eq. (11).
    """
    run = paper_run(*options)
    controller = Mpc(run.site, weight, max_command)
    x, w, u, cost = [], [], [], []
    for tick in Simulation(run, controller).ticks():
        x.append((tick.x1, tick.x2))
        rain, evaporated, *_ = run.forecast.at(tick.k)
        w.append(np.transpose((rain, evaporated)))
        u.append(tick.command)
        cost.append(controller.cost)
    assert controller.fallbacks == 0
    return np.array(x), np.array(w), np.array(u), np.array(cost)


def program(site: Site, x: Any, w: Any, u_bar: Any, w_bar: Any) -> tuple[Any, Any]:
    """Stack Eq. (10) over the look-ahead at n ticks: roof depth - z_veg = r + G U.

    Args:
        site: the parameters of Table I.
        x: volumes at each tick, shape (n, 2).
        w: forecasts, shape (n, M, 2).
        u_bar: command of the operating point, shape (n,).
        w_bar: disturbance of the operating point, shape (n, 2).

    Returns:
        G, shape (n, M, M), and r, shape (n, M).
    """
    size = w.shape[1]
    slope, B, C, b = linear_model(site, *x.T, u_bar, *w_bar.T)
    powers = [np.linalg.matrix_power(slope + np.eye(2), power) for power in range(size)]
    drift = np.einsum("nij,nkj->nki", C, w - w_bar[:, None]) + (b - B * u_bar[:, None])[:, None]
    G = np.zeros((len(x), size, size))
    r = np.repeat(x[:, 1:] / site.a2 - site.z_veg, size, axis=1)
    for row in range(size):
        for column in range(row + 1):
            power = powers[row - column]
            G[:, row, column] = np.einsum("ni,ni->n", power[:, 1], B) / site.a2
            r[:, row] += np.einsum("ni,ni->n", power[:, 1], drift[:, column]) / site.a2
    return G, r


def programs(x: Any, w: Any, u: Any) -> tuple[Any, Any]:
    """Return the program of each tick of a run, about the operating points of step 6."""
    u_bar = np.concatenate([[0.0], u[:-1]])
    earlier = np.cumsum(w[:-1, 0], axis=0) / np.arange(1, len(u))[:, None]
    return program(PAPER_SITE, x, w, u_bar, np.concatenate([np.zeros((1, 2)), earlier]))


def solution(G: Any, r: Any, weight: float, bound: float = math.inf) -> Any:
    """Minimise weight U'U + |r + G U|^2 over 0 <= U <= bound exactly, by an active set."""
    stacked = np.concatenate([np.eye(len(r)), G / math.sqrt(weight)])
    target = np.concatenate([np.zeros(len(r)), -r / math.sqrt(weight)])
    if bound == math.inf:
        return nnls(stacked, target)[0]
    return lsq_linear(stacked, target, (0, bound), method="bvls", tol=1e-15).x


@pytest.mark.parametrize("weight", RUNS)
def test_commands_are_exact_over_a_whole_run(weight: float) -> None:
    """For every tick, with their cost; with the smallest weight the last are clipped to 0."""
    x, w, u, cost = walk(weight, *RUNS[weight])
    assert (u[-1] == 0) == (weight == 1e-5)
    G, r = programs(x, w, u)
    U = np.array([solution(*program, weight) for program in zip(G, r, strict=True)])
    np.testing.assert_allclose(u, U[:, 0], rtol=0, atol=1e-8)
    assert u.min() >= 0
    # J of Eq. (11) also counts the present depth.
    depths = np.column_stack([x[:, 1] / PAPER_SITE.a2 - PAPER_SITE.z_veg,
                              r + np.einsum("nij,nj->ni", G, U)])
    J = (depths**2).sum(axis=1) + weight * (U**2).sum(axis=1)
    np.testing.assert_allclose(cost, J, rtol=1e-8, atol=1e-14)


def test_commands_below_an_upper_bound_are_exact() -> None:
    """From a full cistern the first command would be 1.0179."""
    x, w, u, _ = walk(1e-5, "--initial", "high-low", "--hours", "0.25", max_command=0.3)
    exact = [solution(G, r, 1e-5, 0.3)[0] for G, r in zip(*programs(x, w, u), strict=True)]
    np.testing.assert_allclose(u, exact, rtol=0, atol=1e-8)
    assert exact[0] == pytest.approx(0.3, rel=1e-12)
    assert u.max() == 0.3


def first_inputs() -> tuple[float, float, list[float], list[float]]:
    """Return levels and weather at which every controller of the paper pumps."""
    x1, x2 = 25 * 3 / 1.3, 68.8 * 0.0457 / 1.3
    return x1 / 25, x2 / 68.8, [0.0] * 10, [1e-6] * 10


def exact_first_command(site: Site, inputs: Any, weight: float, u_bar: float = 0.0) -> float:
    """Solve a tick's program about w-bar = 0; b and C w~ depend on w-bar, but not their sum."""
    cistern, roof, rain, evaporated = inputs
    x = np.array([[cistern * site.a1, roof * site.a2]])
    w = np.transpose((rain, evaporated))[None]
    G, r = program(site, x, w, np.array([u_bar]), np.zeros((1, 2)))
    return float(solution(G[0], r[0], weight)[0])


@given(
    site=sites(),
    data=st.data(),
    size=st.integers(1, 25),
    weight=st.floats(-6, 0).map(lambda power: 10**power),
    rain=st.floats(0, 1e-4),
    evaporated=st.floats(0, 1e-3),
)
def test_first_command_of_any_site_is_exact(
    site: Site, data: st.DataObject, size: int, weight: float, rain: float, evaporated: float
) -> None:
    """Random sites, look-aheads, states and weathers; to 1e-8 of the command if it is large."""
    cistern, roof = data.draw(st.floats(0, 2 * site.z_o)), data.draw(st.floats(0, 1.5 * site.z_veg))
    inputs = cistern, roof, [rain] * size, [evaporated] * size
    command = Mpc(replace(site, M=size), weight, math.inf).command(*inputs)
    assert command == pytest.approx(exact_first_command(site, inputs, weight), rel=1e-8, abs=1e-8)


def test_weight_may_change_between_two_ticks() -> None:
    """The command follows from the new weight, about the old command."""
    mpc = Mpc(PAPER_SITE, 1e-3, math.inf)
    before = mpc.command(*first_inputs())
    mpc.weight = 1e-2
    expected = exact_first_command(PAPER_SITE, first_inputs(), 1e-2, before)
    assert mpc.command(*first_inputs()) == pytest.approx(expected, abs=1e-8)
    assert expected < before / 9


def test_unsolved_program_pumps_nothing(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One iteration is too few: OSQP reports this each tick, and its numbers are not used."""
    with monkeypatch.context() as patch:
        patch.setitem(module._SOLVER_SETTINGS, "max_iter", 1)
        mpc = Mpc(PAPER_SITE, 1e-3, math.inf)
    for fallbacks in (1, 2, 3):
        assert mpc.command(*first_inputs()) == 0.0
        assert mpc.fallbacks == fallbacks
        assert math.isnan(mpc.cost)
        assert mpc.status != 1
    assert [record.levelno for record in caplog.records] == [logging.WARNING] * 3


@pytest.mark.parametrize(
    ("bad", "index"), [(math.nan, 0), (math.inf, 1), (math.nan, 2), (math.inf, 3)]
)
def test_what_is_no_number_pumps_nothing(bad: float, index: int) -> None:
    """A NaN level, or a NaN at a forecast's end: 0 for that tick; the next is exact again."""
    mpc = Mpc(PAPER_SITE, 1e-3, math.inf)
    good = first_inputs()
    spoilt: list[Any] = list(good)
    spoilt[index] = bad if index < 2 else [*spoilt[index][:-1], bad]
    assert mpc.command(*good) > 0.01
    assert mpc.command(*spoilt) == 0.0
    assert mpc.fallbacks == 1
    assert math.isnan(mpc.cost)
    assert mpc.status != 1
    expected = exact_first_command(PAPER_SITE, good, 1e-3)
    assert mpc.command(*good) == pytest.approx(expected, abs=1e-8)
    assert (mpc.status, mpc.fallbacks) == (1, 1)
