"""The clairvoyant bound: never above the cost of a run, and close to the cost of its plan."""

from __future__ import annotations

import heapq
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from paper import (
    PAPER_SITE,
    exact_flows,
    measured_sites,
    metrics_of,
    paper_run,
    run_of_hours,
    site_file,
    sites,
)

from greenroof_ros import bound as module
from greenroof_ros.bound import main
from greenroof_ros.experiment.clairvoyant import NoBoundError, clairvoyant_bound
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.experiment.plan import recursion_plan
from greenroof_ros.experiment.run import Run
from greenroof_ros.model.metrics import Metrics
from greenroof_ros.model.site import Site

Hours = Sequence[tuple[float, float, bool]]
"""Rain (mm/h), evapotranspiration (mm/day) and whether there is frost, hour by hour."""

DRY_HOUR = [(0.0, 0.0, False)]


class Given:
    """A controller with given commands, which repeat."""

    def __init__(self, commands: Sequence[float]) -> None:
        self._commands = commands
        self._asked = -1

    def command(self, *_: object) -> float:
        """Return the next command."""
        self._asked += 1
        return self._commands[self._asked % len(self._commands)]

    def skip(self) -> None:
        """Keep the next command for the next call."""


def least_sum(c: Sequence[float], most: Sequence[float]) -> float:
    """Minimise sum |c_k + P_k| over P_0 = 0 and 0 <= P_{k+1} - P_k <= most_k, exactly.

    The least cost to reach each P is a convex, piecewise linear function. Its corners left of
    the minimum are in one heap, those on the right in another; a tick shifts the right ones by
    the volume that can be pumped, and |c_k + P| adds a corner to each.
    """
    left, right, moved = [0.0] * len(c), [0.0] * len(c), 0.0
    total = abs(c[0])
    for volume, step in zip(c[1:], most, strict=True):
        moved += step
        total += max(0.0, -left[0] + volume)
        corner = -heapq.heappushpop(left, volume)
        heapq.heappush(right, corner - moved)
        total += max(0.0, -volume - right[0] - moved)
        corner = heapq.heappushpop(right, -volume - moved) + moved
        heapq.heappush(left, -corner)
    return total


def least_cost(run: Run) -> float:
    """Return the optimum of a run in which only the full flow limits the pumps, from Eq. (1)."""
    site = run.site
    c, most, x1 = [run.x2 - site.x2_star], [], run.x1
    for k in range(run.steps):
        rain = run.series.precipitation[k]
        c.append(c[-1] + site.tau * (rain * site.a2 - run.series.evapotranspiration[k]))
        most.append(site.tau * exact_flows(site, x1, 0, 1)[1])
        x1 += site.tau * rain * site.a_in
    return least_sum(c, most)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--initial", "low-low"), 4422),
        (("--initial", "low-low", "--start", "2021-07-08T05:00"), 25389),
    ],
)
def test_known_windows(options: tuple[str, ...], expected: float) -> None:
    """The optimum for each second, exact by another method, lies between bound and plan."""
    run = paper_run(*options)
    exact = least_cost(run)
    bound = clairvoyant_bound(run)
    assert bound.bound_m3 == pytest.approx(expected, abs=1)
    assert exact == pytest.approx(expected, abs=1)
    assert exact * (1 - 3e-5) < bound.bound_m3 <= exact
    assert exact * (1 - 1e-9) < bound.plan_m3 < exact * (1 + 1e-5)
    assert bound.pumped_m3 > 0


HOURS = st.lists(
    st.tuples(
        st.floats(0, 500) | st.just(0.0), st.floats(0, 50) | st.just(0.0), st.booleans()
    ),
    min_size=1, max_size=3,
)
DROUGHT = [(0.0, 50.0, False)] * 2


@settings(max_examples=40)
@given(
    site=st.just(PAPER_SITE) | sites() | measured_sites(),
    hours=HOURS,
    cistern=st.floats(0, 5) | st.floats(0, 1).map(lambda share: 0.75 * share),
    roof=st.floats(0, 1.5) | st.just(0.0),
    max_command=st.sampled_from([1.0, 1.0, 2.0, 0.5, 0.001]),
    shares=st.lists(st.floats(0, 1) | st.sampled_from([0.0, 1.0]), min_size=1, max_size=40),
    tau=st.sampled_from([30.0, 30.0, 3600.0]),
)
@example(PAPER_SITE, DROUGHT, 0.0, 0.01, 1.0, [0.0], 30.0)
@example(PAPER_SITE, DROUGHT, 0.751, 0.01, 1.0, [1.0], 30.0)
@example(PAPER_SITE, [(500.0, 0.0, False)] * 3, 3.0, 0.9, 1.0, [1.0], 30.0)
@example(PAPER_SITE, [(0.0, 50.0, False), (0.0, 50.0, True)], 2.0, 0.0914, 1.0, [1.0], 30.0)
def test_no_run_is_below(
    site: Site, hours: Hours, cistern: float, roof: float, max_command: float,
    shares: list[float], tau: float,
) -> None:
    """Any commands, including the plan's, in any weather: dry roofs, draining ones, frost.

    Also with ticks of an hour, in which much happens at once.
    """
    site = replace(site, tau=tau)
    run = run_of_hours(hours, cistern * site.a1, roof * site.z_cap, site)
    fine = clairvoyant_bound(run, max_command, 1)
    coarse = clairvoyant_bound(run, max_command, 7)
    slack = 1e-6 * (fine.bound_m3 + site.x2_star)
    if run.steps >= 7:
        assert coarse.bound_m3 <= fine.bound_m3 + slack
    for cost in (
        fine.plan_m3,
        coarse.plan_m3,
        metrics_of(run, Given([max_command * share for share in shares]))["total_deviation_m3"],
        metrics_of(run, Given([max_command]))["total_deviation_m3"],
        metrics_of(run, Given([0.0]))["total_deviation_m3"],
    ):
        assert fine.bound_m3 <= cost + slack


@settings(max_examples=30)
@given(
    site=st.just(PAPER_SITE) | measured_sites(), hours=HOURS, cistern=st.floats(0, 5),
    roof=st.floats(0, 1.5),
)
@example(PAPER_SITE, DROUGHT, 3.0, 0.002)
def test_in_frost_the_bound_is_the_run(
    site: Site, hours: Hours, cistern: float, roof: float
) -> None:
    """In frost only one run is possible: the roof dries out, drains and fills by itself.

    Only within a rounding of the drainage limit, Eq. (4), does the bound leave open which side
    it is on.
    """
    site = replace(site, tau=30.0)
    frozen = [(rain, evapotranspiration, True) for rain, evapotranspiration, _ in hours]
    run = run_of_hours(frozen, cistern * site.a1, roof * site.z_cap, site)
    bound = clairvoyant_bound(run, block=1)
    metrics = Metrics()
    roofs = [tick.x2 for tick in closed_loop(run, Given([1.0]), metrics)]
    if site.field_capacity is None:
        assume(min(abs(x2 / site.z_cap - 1) for x2 in roofs) > 1e-8)
    only = metrics["total_deviation_m3"]
    assert bound.plan_m3 == only
    assert bound.bound_m3 == pytest.approx(only, rel=1e-6, abs=1e-6 * site.x2_star)
    assert bound.pumped_m3 == 0


@pytest.mark.parametrize("start", ["2021-07-07T02:00", "2021-07-08T05:00"])
def test_the_bound_of_a_measured_roof_is_close(start: str, tmp_path: Path) -> None:
    """Twelve hours of the Neubrandenburg roof: drizzle while the roof is filled, and a storm.

    The recursion keeps the soil's equations: for the drizzle its plan beats the program's.
    """
    site = site_file(tmp_path, base="site_neubrandenburg.yaml", tau=10.0)
    run = paper_run("--site", str(site), "--start", start, "--hours", "12")
    bound = clairvoyant_bound(run)
    assert bound.bound_m3 <= bound.plan_m3 < 1.02 * bound.bound_m3
    recursion = recursion_plan(run).total_m3
    assert bound.bound_m3 <= recursion
    if start == "2021-07-07T02:00":
        assert recursion < bound.plan_m3


# One tick of 10 s at full flow from 75 m3, Table I: b sqrt(3 + 55.2 - 16).
FULL = 10 * exact_flows(PAPER_SITE, 75, 0, 1)[1]


@pytest.mark.parametrize(
    ("x1", "below", "max_command", "frost", "expected"),
    [
        # Filled at full flow: 3.5, 2.5, 1.5, 0.5, 0, 0.
        (75.0, 3.5, 1.0, False, 8.0),
        # At half of it: 3.5, 3, 2.5, 2, 1.5, 1.
        (75.0, 3.5, 0.5, False, 13.5),
        # Not at all.
        (75.0, 3.5, 1.0, True, 21.0),
        # Above the target nothing can be done.
        (75.0, -2.0, 1.0, False, 12.0),
        # The cistern is just below the pumps' suction level.
        (18.74, 3.5, 1.0, False, 21.0),
    ],
)
def test_five_ticks_without_weather(
    x1: float, below: float, max_command: float, frost: bool, expected: float
) -> None:
    """Six states, solved by hand in units of a tick's full flow."""
    run = run_of_hours([(0.0, 0.0, frost)], x1, PAPER_SITE.x2_star - below * FULL, steps=5)
    bound = clairvoyant_bound(run, max_command, 1)
    assert bound.bound_m3 == pytest.approx(expected * FULL, rel=1e-6)
    # The real flow falls slightly with the cistern's level.
    assert bound.bound_m3 * (1 - 1e-6) <= bound.plan_m3 < bound.bound_m3 * (1 + 1e-3)


def test_a_cistern_at_the_suction_level_gives_one_tick() -> None:
    """The last tick can draw below it: 3.5, 2.5, 2.5, 2.5, 2.5, 2.5 of that flow."""
    full = 10 * exact_flows(PAPER_SITE, 18.75, 0, 1)[1]
    run = run_of_hours(DRY_HOUR, 18.75, PAPER_SITE.x2_star - 3.5 * full, steps=5)
    bound = clairvoyant_bound(run, block=1)
    assert bound.bound_m3 == pytest.approx(16 * full, rel=1e-6)
    assert bound.plan_m3 == pytest.approx(16 * full, rel=1e-6)
    assert bound.pumped_m3 == pytest.approx(full, rel=1e-6)


def test_before_frost_the_roof_is_filled_above_the_target() -> None:
    """Pumping stops at z_veg, but the last tick before it can take the roof above it."""
    hours = [(0.0, 10.0, False)] * 2 + [(0.0, 10.0, True)] * 24
    bound = clairvoyant_bound(run_of_hours(hours, 75.0, PAPER_SITE.x2_star), block=6)
    assert 0 < bound.bound_m3 < bound.plan_m3 < 1.01 * bound.bound_m3


def test_a_bound_of_zero_has_no_gap() -> None:
    """A roof at its target, and no weather."""
    run = run_of_hours(DRY_HOUR, 75.0, PAPER_SITE.x2_star)
    bound = clairvoyant_bound(run)
    assert bound.bound_m3 == 0
    assert module._result(run, 1.0, bound, recursion_plan(run))["gap"] is None


@pytest.mark.parametrize("max_command", [1.0, 0.02])
def test_the_recursions_plan_is_a_run(max_command: float, tmp_path: Path) -> None:
    """It is not below the bound, nor above on/off."""
    site = site_file(tmp_path, tau=10.0)
    run = paper_run("--controller", "onoff", "--site", str(site), "--hours", "12")
    plan = recursion_plan(run, max_command)
    assert clairvoyant_bound(run, max_command).bound_m3 <= plan.total_m3
    onoff = replace(run, parameters={**run.parameters, "fraction": max_command})
    assert plan.total_m3 <= metrics_of(onoff)["total_deviation_m3"]
    assert plan.pumped_m3 > 0


def call(monkeypatch: pytest.MonkeyPatch, *options: str) -> object:
    """Run the command with these options and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["bound", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The table and the JSON have the same values."""
    assert call(monkeypatch, "--hours", "0.5", "--block", "30", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["block_s"] == 30
    assert result["steps"] == 1800
    best = min(result["plan_m3"], result["recursion_m3"])
    assert 0 < result["bound_m3"] <= best
    assert result["gap"] == pytest.approx(best / result["bound_m3"] - 1)
    assert call(monkeypatch, "--hours", "0.5", "--block", "30") == 0
    shown = capsys.readouterr().out
    totals = [f"{result[name]:.2f}" for name in ("bound_m3", "plan_m3", "recursion_m3")]
    for words in (*totals, f"{100 * result['gap']:.4f} %", "HiGHS", "published"):
        assert words in shown


@pytest.mark.parametrize("options", ["--block 0", "--block 1.5", "--max-command inf"])
def test_wrong_options(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], options: str
) -> None:
    """Exit code 2, and a message that names what is wrong."""
    assert call(monkeypatch, *options.split()) == 2
    assert options.split()[0] in capsys.readouterr().err


def test_no_optimum(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The solver's own message, and exit code 1."""
    monkeypatch.setattr(
        "scipy.optimize.linprog",
        lambda *_, **__: SimpleNamespace(status=4, message="numbers too large"),
    )
    with pytest.raises(NoBoundError, match="numbers too large"):
        clairvoyant_bound(run_of_hours(DRY_HOUR, 75.0, 2.0))
    assert call(monkeypatch, "--hours", "0.1") == 1
    captured = capsys.readouterr()
    assert "numbers too large" in captured.err
    assert captured.out == ""


def test_a_slow_one_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On standard error, so standard output has only the JSON."""
    monkeypatch.setattr(module, "_PATIENCE_S", 0.0)
    assert call(monkeypatch, "--hours", "0.1", "--json") == 0
    captured = capsys.readouterr()
    assert "solving for 360 ticks" in captured.err
    assert math.isfinite(json.loads(captured.out)["bound_m3"])
