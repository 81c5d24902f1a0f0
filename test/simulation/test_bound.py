"""The clairvoyant bound: never above the cost of a run, and close to the cost of a plan."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from paper import (
    PAPER_SITE,
    SLOW,
    exact_flows,
    field_capacity_sites,
    metrics_of,
    paper_run,
    run_of_hours,
    site_file,
    sites,
)

from greenroof_ros.commands import bound as module
from greenroof_ros.commands.bound import main
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.simulation.bound import BLOCK_S, clairvoyant_bound, simulate_plan
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site

Hours = Sequence[tuple[float, float, bool]]
"""Rain (mm/h), evapotranspiration (mm/day) and whether there is frost, hour by hour."""

DRY_HOUR = [(0.0, 0.0, False)]
# Quiet hours; a run of hours begins at 01:00 by Toronto's clock.
TORONTO, ALWAYS = "America/Toronto", ("00:00-23:59",)


class Commands:
    """A controller with given commands, which repeat."""

    def __init__(self, commands: Sequence[float]) -> None:
        self._commands = commands
        self._count = -1

    def command(self, *_: object) -> float:
        """Return the next command."""
        self._count += 1
        return self._commands[self._count % len(self._commands)]

    def skip(self) -> None:
        """Keep the next command for the next call."""


HOURS = st.lists(
    st.tuples(
        st.floats(0, 500) | st.just(0.0), st.floats(0, 50) | st.just(0.0), st.booleans()
    ),
    min_size=1, max_size=3,
)
DROUGHT = [(0.0, 50.0, False)] * 2


@settings(max_examples=20)
@given(
    site=st.just(PAPER_SITE) | sites() | field_capacity_sites(),
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
    """Any commands, and lookahead's plan, in any weather: dry roofs, draining ones, frost.

    Also with ticks of an hour, in which much happens at once.
    """
    site = replace(site, tau=tau)
    run = run_of_hours(hours, cistern * site.a1, roof * site.z_cap, site)
    fine = clairvoyant_bound(run, site.tau, max_command)
    coarse = clairvoyant_bound(run, 7 * site.tau, max_command)
    slack = 1e-6 * (fine + site.x2_star)
    if run.steps >= 7:
        assert coarse <= fine + slack
    for cost in (
        simulate_plan(run, max_command)["total_deviation_m3"],
        metrics_of(run, Commands([max_command * share for share in shares]))["total_deviation_m3"],
        metrics_of(run, Commands([max_command]))["total_deviation_m3"],
        metrics_of(run, Commands([0.0]))["total_deviation_m3"],
    ):
        assert fine <= cost + slack


@settings(max_examples=12)
@given(
    site=st.just(PAPER_SITE) | field_capacity_sites(), hours=HOURS, cistern=st.floats(0, 5),
    roof=st.floats(0, 1.5), frost=st.booleans(),
)
@example(PAPER_SITE, DROUGHT, 3.0, 0.002, True)
@example(PAPER_SITE, DROUGHT, 3.0, 0.002, False)
def test_without_pumping_the_bound_is_the_run(
    site: Site, hours: Hours, cistern: float, roof: float, frost: bool
) -> None:
    """In frost or quiet hours one run is possible: the roof dries, drains and fills by itself.

    Only within a rounding of the drainage limit, Eq. (4), does the bound leave open which side
    it is on.
    """
    site = replace(site, tau=30.0, quiet_hours=None if frost else ALWAYS, time_zone=TORONTO)
    still = [(rain, evapotranspiration, frost) for rain, evapotranspiration, _ in hours]
    run = run_of_hours(still, cistern * site.a1, roof * site.z_cap, site)
    bound = clairvoyant_bound(run, site.tau)
    simulation = Simulation(run, Commands([1.0]))
    roofs = [tick.x2 for tick in simulation.ticks()]
    if site.field_capacity is None:
        assume(min(abs(x2 / site.z_cap - 1) for x2 in roofs) > 1e-8)
    only = simulation.metrics.results(simulation.site.state).metrics["total_deviation_m3"]
    plan = simulate_plan(run)
    assert (plan["total_deviation_m3"], plan["pumped_m3"]) == (only, 0)
    assert bound == pytest.approx(only, rel=1e-6, abs=1e-6 * site.x2_star)


@pytest.mark.parametrize(
    ("base", "tau", "start", "gap"),
    [
        ("site.yaml", 1.0, "2021-07-08T05:00", 4e-5),
        # Drizzle while a roof with a field-capacity soil is filled.
        ("site_neubrandenburg.yaml", 10.0, "2021-07-07T02:00", 0.02),
    ],
)
def test_bound_and_plan_are_close(
    tmp_path: Path, base: str, tau: float, start: str, gap: float
) -> None:
    """The minimum of twelve hours lies between the bound and the plan; lookahead is as good."""
    site = site_file(tmp_path, base=base, tau=tau)
    run = paper_run(
        "--controller", "lookahead", "--horizon", "12", "--days-after", "0", "--site", str(site),
        "--start", start, "--hours", "12",
    )
    bound, plan = clairvoyant_bound(run, BLOCK_S), simulate_plan(run)
    assert bound <= plan["total_deviation_m3"] < (1 + gap) * bound
    assert plan["pumped_m3"] > 0
    assert bound <= metrics_of(run)["total_deviation_m3"] < 1.001 * plan["total_deviation_m3"]


# One tick of 20 s at full flow from 75 m3, Table I: b sqrt(3 + 55.2 - 16).
FULL = 20 * exact_flows(PAPER_SITE, 75, 0, 1)[1]


@pytest.mark.parametrize(
    ("x1", "max_command", "quiet", "min_off", "x2", "bound", "plan"),
    [
        # Filled at full flow: 3.5, 2.5, 1.5, 0.5 and five times 0; at half of it: 3.5, 3, ... 0.
        (75.0, 1.0, "12:00-13:00", 0.0, 3.5, 8.0, 8.0),
        (75.0, 0.5, "12:00-13:00", 0.0, 3.5, 14.0, 14.0),
        # Not at all: the cistern is just below the pumps' suction level.
        (18.74, 1.0, "12:00-13:00", 0.0, 3.5, 31.5, 31.5),
        # The night ends at 01:01, after three ticks: 3.5 four times, then 2.5, 1.5, 0.5, 0 and 0.
        (75.0, 1.0, "23:00-01:01", 0.0, 3.5, 18.5, 18.5),
        # Three ticks of pumping, a minute's pause: 10.5, 9.5, 8.5, four times 7.5, 6.5 and 5.5.
        (75.0, 1.0, "01:01-01:02", 0.0, 10.5, 70.5, 70.5),
        # The pumps then stay off for four ticks in all, although the pause is over after three.
        (75.0, 1.0, "01:01-01:02", 80.0, 10.5, 70.5, 72.5),
    ],
)
def test_eight_ticks_without_weather(
    x1: float, max_command: float, quiet: str, min_off: float, x2: float, bound: float, plan: float
) -> None:
    """From 01:00 on by Toronto's clock, solved by hand, all in units of a tick's full flow.

    The bound leaves the pumps' minimum times out; the plan keeps them, with an exact sensor. The
    real flow falls slightly with the cistern's level.
    """
    site = replace(SLOW, tau=20.0, quiet_hours=(quiet,), time_zone=TORONTO)
    run = run_of_hours(DRY_HOUR, x1, site.x2_star - x2 * FULL, site, length_h=8 * 20 / 3600)
    run = replace(run, sensor_and_pump=SensorAndPump(pump_min_off=min_off, roof_offset=0.1))
    found = clairvoyant_bound(run, site.tau, max_command)
    assert found == pytest.approx(bound * FULL, rel=1e-6)
    total = simulate_plan(run, max_command)["total_deviation_m3"]
    assert plan * FULL * (1 - 1e-6) <= total < plan * FULL * (1 + 1e-3)


def test_before_frost_the_roof_is_filled_to_the_target() -> None:
    """In ticks of ten seconds the pumps stop within the last one, at z_veg."""
    hours = [(0.0, 10.0, False)] * 2 + [(0.0, 10.0, True)] * 24
    run = run_of_hours(hours, 75.0, PAPER_SITE.x2_star)
    last = round(2 * 3600 / run.site.tau) - 1
    # A thousandth of the flow replaces what evaporates.
    filled = metrics_of(run, Commands([0.001] * last + [1.0]))["total_deviation_m3"]
    bound = clairvoyant_bound(run, 6 * run.site.tau)
    assert 0 < bound < filled < 1.01 * bound


def test_a_bound_of_zero_has_no_gap() -> None:
    """A roof at its target, and no weather."""
    run = run_of_hours(DRY_HOUR, 75.0, PAPER_SITE.x2_star)
    assert clairvoyant_bound(run, BLOCK_S) == 0
    assert module._result(run, 1.0, 0.0, simulate_plan(run), 60.0)["gap"] is None


def call(monkeypatch: pytest.MonkeyPatch, *options: str) -> object:
    """Run the command with these options and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["bound", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The table and the JSON have the same values; also for pumps at a part of their flow."""
    options = ("--hours", "0.5", "--block", "30", "--max-command", "0.02")
    assert call(monkeypatch, *options, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["block_s"] == 30
    assert result["steps"] == 1800
    assert 0 < result["bound_m3"] <= result["plan_m3"] < 1.01 * result["bound_m3"]
    assert result["gap"] == pytest.approx(result["plan_m3"] / result["bound_m3"] - 1)
    assert call(monkeypatch, *options) == 0
    shown = capsys.readouterr().out
    totals = [f"{result[name]:.2f}" for name in ("bound_m3", "plan_m3")]
    for words in (*totals, f"{100 * result['gap']:.4f} %", "published"):
        assert words in shown
