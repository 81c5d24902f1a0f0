"""The bound of the discharge: no run is beneath its frontier, and by hand it is tight."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import run_in, site_file, site_with, weather_of

from greenroof_ros.commands import bound as module
from greenroof_ros.commands.bound import main
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.registry import choose_class
from greenroof_ros.simulation.bound import WEIGHTS, Steps, bound_discharge, find_frontier
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.run import Run

# 10 m3 below the upper outlet; the pumps leave 0.25 m3.
SITE = site_with(
    a1=5.0, z_o=2.0, a_in=300.0, runoff_coefficient=0.9, z_pump=0.0, z_H=0.05,
    low_outlet_level=0.11, low_outlet_radius=0.0125, low_outlet_valve=True, tau=60.0,
)
HOUR = 3600.0


class AnyCommands:
    """Commands pumps and valve at random, and keeps them for up to 200 ticks."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()
    outlet = 0.0
    seed = 0

    def __init__(self, site: object) -> None:
        self._random, self._left, self._pump = np.random.default_rng(self.seed), 0, 0.0

    def command(self, *_: object) -> float:
        """Return a command to the pumps."""
        if not self._left:
            self._left = int(self._random.integers(1, 200))
            self._pump = float(self._random.choice([0.0, 0.0, 0.3, 1.0]))
            self.outlet = float(self._random.choice([0.0, 1.0, self._random.random()]))
        self._left -= 1
        return self._pump

    def skip(self) -> None:
        """Go on with the same commands."""

    def statistics(self) -> None:
        """Return nothing."""


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


def steps_of(
    wet: list[bool], inflow: list[float], pumped: list[float], highest: list[float]
) -> Steps:
    """Return hours of the site above; the volumes with a closed valve are at hand."""
    return Steps(
        np.full(len(wet), HOUR), np.array(wet), np.array(inflow), np.array(pumped),
        np.array(highest), 0.25,
    )


def test_what_the_valve_cannot_let_out_before() -> None:
    """From 10 m3, one dry hour lets out 6.5 m3: of 8 m3, 1.5 m3 overflow.

    The open valve takes c_low sqrt(1.89 m) from a full cistern, 1.8234e-3 m3/s x 3600 s.
    """
    let_out = 3600 * SITE.c_low * math.sqrt(1.89)
    assert let_out == pytest.approx(6.564, abs=1e-3)
    points = find_frontier(SITE, 10.0, steps_of([False, True], [0, 8], [0, 0], [10, 10, 10]))
    assert [point.weight for point in points] == [WEIGHTS[0]]
    assert points[0].wet_discharge_m3 == pytest.approx(8 - let_out, abs=0.01)


def test_mains_for_discharge() -> None:
    """7 m3 of rain, then 8 m3 for the roof: room for the rain costs as much mains water.

    In an hour before it the valve lets out at most 6.56 m3 of 10 m3. With the least discharge,
    0.44 m3, 10 m3 are there for the 8 m3. Without rain to come, what is let out is lacking.
    """
    site = replace(SITE, mains_level=0.1, mains_flow=1e-2)
    wet, highest = [False, True, False], [10.0, 10.0, 10.0, 10.0]
    points = find_frontier(site, 10.0, steps_of(wet, [0, 7, 0], [0, 0, 8], highest))
    assert len(points) == 1
    assert points[0].wet_discharge_m3 == pytest.approx(0.436, abs=0.01)
    assert points[0].mains_m3 == pytest.approx(0.0, abs=1e-6)
    # Now 12 m3 are needed before the rain: 2.25 m3 of mains water, and 7 m3 fit.
    points = find_frontier(site, 10.0, steps_of(wet, [0, 0, 7], [0, 12, 0], highest))
    assert points[-1].mains_m3 == pytest.approx(2.25, abs=0.01)


def test_a_dry_part_of_an_hour_costs_nothing() -> None:
    """Rain in five minutes, and none before: what is let out 55 minutes earlier is not wet."""
    minutes = np.zeros((4, 60))
    minutes[2, 55:] = 120.0  # 10 mm, 2.7 m3, in five minutes
    site = replace(SITE, z_veg=0.01, x2_star=0.6875)
    run = run_in(weather_of(minutes, 0.0), site, 9.0, 3.142)
    found = bound_discharge(run, simulate(run, every=1)[1])
    assert found[0].wet_discharge_m3 == pytest.approx(0, abs=1e-6)


def test_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It prints the frontier as a table or as JSON, and refuses a site without a valve."""
    changes: dict[str, Any] = {
        "a1": 5.0, "z_o": 2.0, "a_in": 300.0, "z_pump": 0.0, "z_H": 0.05, "tau": 60.0,
        "low_outlet_level": 0.11, "low_outlet_radius": 0.0125,
    }
    site = site_file(tmp_path, **changes)
    given = ["bound", "--of", "discharge", "--site", str(site), "--hours", "3"]

    def run(*options: str) -> int | str | None:
        monkeypatch.setattr(module.sys, "argv", [*given, *options])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code

    assert run() == 2
    assert "low_outlet_valve: true" in capsys.readouterr().err
    site.write_text(f"{site.read_text()}low_outlet_valve: true\n".replace(
        "low_outlet_valve: false", ""
    ))
    assert run() == 0
    printed = capsys.readouterr().out
    assert "Minimum discharge" in printed
    assert "mains" not in printed and printed.count("│ bound ") == 1  # the site has no mains top-up
    assert run("--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["frontier"][0].keys() == {"weight", "wet_discharge_m3", "mains_m3"}
    assert result["wet_discharge_m3"] >= result["frontier"][0]["wet_discharge_m3"] - 1e-6
    for option in ("--block", "--max-command"):
        assert run(option, "60" if option == "--block" else "0.5") == 2
        assert "cannot be used with --of discharge" in capsys.readouterr().err
