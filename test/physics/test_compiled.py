"""The compiled plant and season: the bits of the plain ones, and the edits that they notice."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import ANY_SITE, PAPER_SITE, TABLE_I, VALVE, run_of_hours
from places import CHECKOUT, CONFIG

from greenroof_ros.physics.compiled import MIN_COMPILED, can_compile, compiled, records
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.pump import SensorAndPump
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

pytestmark = pytest.mark.skipif(not can_compile(), reason="numba is not installed")

CATCHMENT = read_site(CONFIG / "site_catchment.yaml")


@settings(max_examples=200)
@given(
    site=ANY_SITE, tau=st.sampled_from([0.5, 1.0, 10.0, 60.0, 300.0, 3600.0]),
    state=st.tuples(st.floats(0, 1.3), st.floats(0, 1.2), st.floats(0, 1)),
    weather=st.tuples(st.just(0.0) | st.floats(0, 1e-4), st.floats(0, 1e-4)),
    command=st.sampled_from([0.0, 1.0]) | st.floats(0, 2),
    outlet=st.sampled_from([0.0, 1.0]) | st.floats(0, 1),
    pumped=st.just(OWN_PUMPS) | st.floats(0, 0.1),
)
def test_a_tick_has_the_same_bits(
    site: Site, tau: float, state: tuple[float, ...], weather: tuple[float, float],
    command: float, outlet: float, pumped: float,
) -> None:
    p, (x1, x2, layer) = plant_parameters(replace(site, tau=tau)), state
    begin = State(x1 * site.a1 * site.z_o, x2 * site.z_cap, layer * site.layer_storage)
    results = [
        tick(numbers, begin, *weather, command, outlet, pumped)
        for tick, numbers in ((step, p), (compiled(step), records([p])[0]))
    ]
    plain, found = (np.array([*after, *flows]).tobytes() for after, flows in results)
    assert plain == found


# Sites with the policy of their valve, and the errors of their sensors and pumps; those with plans
# are compared in test_season.py.
SEASONS = (
    (replace(PAPER_SITE, tau=1.0), {}, SensorAndPump()),
    (replace(CATCHMENT, tau=10.0, percolation_exponent=6.5), {}, SensorAndPump()),
    (
        replace(CATCHMENT, tau=300.0, a1=3.0, drainage_to_cistern=0.6, valve_closed_in_frost=True,
                **VALVE),
        {"outlet": "drain"}, SensorAndPump(roof_noise=0.001, pump_min_on=900.0),
    ),
    (
        replace(CATCHMENT, tau=600.0, percolation_exponent=1.0, drainage_storage=None,
                drainage_time=None, mains_level=None, mains_flow=None, time_zone="Europe/Berlin",
                utc_offset=1.0, quiet_hours=("22:00-06:00",), **VALVE),
        {"outlet": "drain"}, SensorAndPump(),
    ),
)


def seasons() -> str:
    """Return all that seasons leave, digit by digit: sums, events, and kept ticks.

    Each has as many ticks as are compiled.
    """
    random, results = np.random.default_rng(7), []
    for site, outlet, errors in SEASONS:
        hours = math.ceil(MIN_COMPILED * site.tau / 3600)
        rain = np.where(random.random(hours) < 0.2, random.exponential(6.0, hours), 0.0)
        weather = zip(
            rain.tolist(), random.uniform(0, 6, hours).tolist(),
            (random.random(hours) < 0.1).tolist(), strict=True,
        )
        begin = 0.9 * site.a1 * site.z_o, 0.8 * site.x2_star
        run = run_of_hours(list(weather), *begin, site, **outlet)
        run = replace(run, sensor_and_pump=errors)
        case = Case(site, run.parameters, run, run.x1, run.x2)
        ((result, kept),), hydrograph = simulate_season([case], every=97)
        results.append((result, hydrograph.tolist(), kept.tolist()))
    return repr(results)


def run(code: str, cwd: Path, *arguments: str, **environment: str) -> str:
    """Return what a Python process prints, with its own cache of compiled functions."""
    kept = {key: os.environ[key] for key in os.environ if not key.startswith(("NUMBA", "XDG"))}
    ended = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=cwd, env={**kept, **environment},
        capture_output=True, text=True, check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


PLANT = """
import json, sys
from greenroof_ros.physics.compiled import compiled
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.site.site import Site
p, tick = plant_parameters(Site(**json.loads(sys.argv[1]))), compiled(step)
full, dry = (
    tick(p, State(75.0, roof, 0.0), 0.0, 0.0, 1.0, 1.0, OWN_PUMPS)[1] for roof in (36.0, 0.5)
)
print(full.drainage, dry.pump)
"""
SEASON = """
import os, sys, test_compiled as t
from greenroof_ros.physics.compiled import compiled
from greenroof_ros.simulation.season import find_wet, run_ticks
class Spy:
    def find_spec(self, name, *_):
        if name == "numba.core":
            print(os.environ["NUMBA_DISABLE_INTEL_SVML"])
sys.meta_path.insert(0, Spy())
print(t.seasons())
print("NUMBA_DISABLE_INTEL_SVML" in os.environ)
for function in find_wet, run_ticks:
    for assembly in compiled(function).inspect_asm().values():
        print("svml" in assembly.lower(), "vfmadd" in assembly)
"""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a directory with a copy of the package that has not been compiled."""
    shutil.copytree(
        CHECKOUT / "greenroof_ros", tmp_path / "greenroof_ros",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    for shared in ("config", "msg_defs"):
        (tmp_path / shared).symlink_to(CHECKOUT / shared)
    return tmp_path


def test_edits_are_noticed(copy: Path) -> None:
    """Of a formula and of a constant in files of functions and constants that a tick uses.

    Eq. (4) at 36 m3, and twice this; and the maximum flow, which falls within a minute of steps.
    """
    site = json.dumps({**TABLE_I, "tau": 60.0})
    physics = copy / "greenroof_ros" / "physics"
    drained, full = 7.83e-8 * (36 + 34.4) / 0.5, 0.00842205211502804
    falling = full * (1 - 0.5 * 25 * full / 25 / 42.2)  # by 25 s on average, at a head of 42.2 m
    for file, before, after, flows in (
        ("soil.py", "", "", (drained, falling)),
        ("soil.py", "p.K * p.a2", "2 * p.K * p.a2", (2 * drained, falling)),
        ("parameters.py", "SHORT_SHARE = 0.01", "SHORT_SHARE = 1.0", (2 * drained, full)),
    ):
        text = (physics / file).read_text(encoding="utf-8")
        assert before in text
        (physics / file).write_text(text.replace(before, after, 1), encoding="utf-8")
        found = run(PLANT, copy, site).split()
        assert [float(flow) for flow in found] == pytest.approx(flows, rel=1e-6)
    assert len(list((physics / "__pycache__").glob("tick.step_*.nbi"))) == 3


def test_a_season_of_a_read_only_installation_has_the_same_bits(copy: Path) -> None:
    """No directory can be written for a cache. The plain season is that without numba."""
    for module in (copy / "greenroof_ros").rglob("*.py"):
        module.with_name("__pycache__").write_text("")
    places = f"{copy}:{CHECKOUT / 'test'}:{Path(__file__).parent}"
    without = 'import sys; sys.modules["numba"] = None; import test_compiled as t; '
    plain = run(f"{without}print(t.seasons())", copy, PYTHONPATH=places)
    home = str(copy / "greenroof_ros" / "__pycache__")
    ended = run(SEASON, copy, HOME=home, PYTHONPATH=places)
    svml_is_off, found, is_set, *of_assembly = ended.splitlines()
    assert len(plain) > 100_000 and f"{found}\n" == plain
    # Functions of vectors and fused operations would round in other ways.
    assert (svml_is_off, is_set, *{*of_assembly}) == ("1", "False", "False False")
