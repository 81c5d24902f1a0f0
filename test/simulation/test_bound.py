"""The bounds: never above the result of a run, and close to that of a plan, or solved by hand."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
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
    run_in,
    run_of_hours,
    site_file,
    site_with,
    sites,
    weather_of,
)
from plan_of_a_run import compare, simulate_plan

from greenroof_ros.commands.bound import main
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.physics.pump import SensorAndPump
from greenroof_ros.simulation.bound import (
    BLOCK_S,
    WEIGHTS,
    FrontierPoint,
    bound_discharge,
    clairvoyant_bound,
)
from greenroof_ros.simulation.loop import Simulation, simulate
from greenroof_ros.simulation.run import Run
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
    assert compare(run)["bound"] == f"{bound:.2f} m3"  # the tool prints it
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


# --- the discharge ------------------------------------------------------------------------------

# 10 m3 below the upper outlet; the pumps leave 0.25 m3.
SITE = site_with(
    a1=5.0, z_o=2.0, a_in=300.0, runoff_coefficient=0.9, z_pump=0.0, z_H=0.05,
    low_outlet_level=0.11, low_outlet_radius=0.0125, low_outlet_valve=True, tau=60.0,
)


class AnyCommands(OnOff):
    """Commands pumps and valve at random, and keeps them for up to 200 ticks."""

    outlet = 0.0
    seed = 0

    def __init__(self, site: Site, **_: float) -> None:
        self._random, self._left, self._pump = np.random.default_rng(self.seed), 0, 0.0

    def command(self, *_: object) -> float:
        """Return a command to the pumps."""
        if not self._left:
            self._left = int(self._random.integers(1, 200))
            self._pump = float(self._random.choice([0.0, 0.0, 0.3, 1.0]))
            self.outlet = float(self._random.choice([0.0, 1.0, self._random.random()]))
        self._left -= 1
        return self._pump


def random_run(seed: int) -> Run:
    """Return a run of a few hours at a random site, with rain by the minute or by the hour."""
    random = np.random.default_rng(seed)
    a1, z_o = 10 ** random.uniform(-0.3, 1.3), random.uniform(0.5, 3)
    low = random.uniform(0.11, 0.9 * z_o)
    mains = {"mains_level": random.uniform(0.06, low - 0.01),
             "mains_flow": 10 ** random.uniform(-5, -3)}
    site = site_with(
        a1=a1, z_o=z_o, r_o=10 ** random.uniform(-2.5, -0.8), a_in=random.uniform(50, 400),
        z_pump=0.0, z_H=0.05, low_outlet_level=low,
        low_outlet_radius=10 ** random.uniform(-3, -1.3), low_outlet_valve=True,
        tau=float(random.choice([7, 10, 60, 60, 90, 300, 3600])),
        drainage_to_cistern=float(random.choice([0, 0.5, 1])),
        wet_after=float(random.choice([0, 0.5, 2])), **(mains if random.random() < 0.6 else {}),
    )
    if random.random() < 0.4:
        site = replace(site, monthly_other_demand=(random.uniform(0, 4000),) * 12)
    minutes = np.zeros((int(random.integers(3, 12)), 60))
    for _ in range(random.integers(1, 5)):
        first, count = random.integers(minutes.size), random.integers(1, 90)
        minutes.ravel()[first : first + count] += 10 ** random.uniform(-1.5, 2)
    rain = minutes if random.random() < 0.7 else minutes.mean(axis=1)
    x1, x2 = random.uniform(0, 1.25) * a1 * z_o, site.x2_star * random.uniform(0.5, 1.6)
    return run_in(
        weather_of(rain, random.choice([0.0, 3.0], len(minutes))), site, x1, x2,
        choice=choose_class(type("Own", (AnyCommands,), {"seed": seed})),
    )


@given(st.integers(0, 10**9))
@settings(max_examples=40, deadline=None)
def test_no_run_is_beneath_the_frontier(seed: int) -> None:
    """Whatever the valve does, discharge plus weighted mains is at least that of each point."""
    run = random_run(seed)
    found, ticks = simulate(run, every=1)
    for point in bound_discharge(run, ticks):
        cost = found["wet_discharge_m3"] + point.weight * found.get("mains_m3", 0.0)
        assert cost >= point.wet_discharge_m3 + point.weight * point.mains_m3 - 1e-6


def frontier_of(
    rain: Sequence[float], pumped: Sequence[float], drained: Sequence[float] = (0.0,),
    **changes: float,
) -> list[FrontierPoint]:
    """Return the frontier from 10 m3 on, with rain, pumped and drained water in each hour (m3).

    No hour after rain is wet.
    """
    site = replace(SITE, wet_after=0.0, **changes)
    depths = [1000 * volume / site.effective_catchment for volume in rain]
    run = run_in(weather_of(depths, 0.0), site, 10.0, site.x2_star)
    _, ticks = simulate(run, every=1)
    pump_flow, drainage = (
        np.append(np.repeat(np.resize(volumes, len(rain)) / 3600, 60), 0.0)
        for volumes in (pumped, drained)
    )
    return bound_discharge(run, replace(ticks, pump_flow=pump_flow, drainage=drainage))


def test_what_the_valve_cannot_let_out_before() -> None:
    """From 10 m3, one dry hour lets out 6.5 m3: of 8 m3, 1.5 m3 overflow.

    The open valve takes c_low sqrt(1.89 m) from a full cistern, 1.8234e-3 m3/s x 3600 s.
    """
    let_out = 3600 * SITE.c_low * math.sqrt(1.89)
    assert let_out == pytest.approx(6.564, abs=1e-3)
    (point,) = frontier_of([0, 8], [0, 0])
    assert point.weight == WEIGHTS[0]
    assert point.wet_discharge_m3 == pytest.approx(8 - let_out, abs=0.01)


def test_the_roofs_drainage_counts_in_wet_weather_alone() -> None:
    """1 m3 in the dry hour, and 2 m3 in that with rain, beside what the valve cannot let out."""
    (plain,), (drained,) = (frontier_of([0, 8], [0, 0], volumes) for volumes in ([0, 0], [1, 2]))
    assert drained.wet_discharge_m3 == pytest.approx(plain.wet_discharge_m3 + 2, abs=1e-6)


def test_mains_for_discharge() -> None:
    """7 m3 of rain, then 8 m3 for the roof: room for the rain costs as much mains water.

    In an hour before it the valve lets out at most 6.56 m3 of 10 m3. With the least discharge,
    0.44 m3, 10 m3 are there for the 8 m3. Without rain to come, what is let out is lacking.
    """
    mains = {"mains_level": 0.1, "mains_flow": 1e-2}
    (point,) = frontier_of([0, 7, 0], [0, 0, 8], **mains)
    assert point.wet_discharge_m3 == pytest.approx(0.436, abs=0.01)
    assert point.mains_m3 == pytest.approx(0.0, abs=1e-6)
    # 12 m3 before the rain: the pumps leave 0.25 m3, but for the last tick's 0.2 m3.
    assert frontier_of([0, 0, 7], [0, 12, 0], **mains)[-1].mains_m3 == pytest.approx(2.05, abs=0.01)


def test_a_dry_part_of_an_hour_costs_nothing() -> None:
    """Rain in five minutes, and none before: what is let out 55 minutes earlier is not wet."""
    minutes = np.zeros((4, 60))
    minutes[2, 55:] = 120.0  # 10 mm, 2.7 m3, in five minutes
    site = replace(SITE, z_veg=0.01, x2_star=0.6875)
    run = run_in(weather_of(minutes, 0.0), site, 9.0, 3.142)
    found = bound_discharge(run, simulate(run, every=1)[1])
    assert found[0].wet_discharge_m3 == pytest.approx(0, abs=1e-6)


# --- the command --------------------------------------------------------------------------------

def call(monkeypatch: pytest.MonkeyPatch, *options: str) -> object:
    """Run the command with these options and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["bound", *options])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(monkeypatch, "--hours", "0.5", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    bound = clairvoyant_bound(paper_run("--hours", "0.5"), BLOCK_S)
    assert result["steps"] == 1800 and result["bound_m3"] == pytest.approx(bound) and bound > 0


def test_command_for_the_discharge(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given = "--of", "discharge", "--hours", "3", "--site", "site_valve.yaml"
    assert call(monkeypatch, *given, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["wet_discharge_m3"] >= result["frontier"][0]["wet_discharge_m3"] - 1e-6
