"""Water that toilets, a garden and others draw from the cistern, besides the roof."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from paper import run_in, weather_of
from places import CONFIG

import greenroof_ros as gr
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

# The pumps stop at 0.05 m, which are 0.25 m3.
HOUSE = CONFIG / "site_valve.yaml"
CLOSED = {"level": 0.0, "outlet": "closed"}


@pytest.mark.parametrize("mains", [True, False])
def test_a_cistern_is_drawn_down_to_the_suction_level(mains: bool) -> None:
    """200 l a day for ten days: 1 m3 lasts for 3.75 days; the mains supply 1.25 m3.

    A float valve, which opens at 0.35 m3, begins earlier and keeps the cistern there.
    """
    site = replace(read_site(HOUSE, {"other_demand": 200.0}), tau=60.0)
    if not mains:
        site = replace(site, mains_level=None, mains_flow=None)
    run = run_in(weather_of([0.0] * 240), site, 1.0, site.x2_star, **CLOSED)
    metrics, ticks = simulate(run, every=1)
    assert ticks is not None and ticks.other is not None
    left = 0.35 if mains else 0.25
    assert metrics["final_cistern_m3"] == pytest.approx(left, abs=0.001)
    assert metrics["mains_m3"] == pytest.approx(2.0 - (1.0 - left), abs=0.001)
    assert metrics["other_m3"] == pytest.approx(2.0 if mains else 0.75, abs=0.001)
    assert ticks.other[:5400] == pytest.approx(0.2 / 86400)
    assert metrics["pumped_m3"] == metrics["discharge_m3"] == 0


def test_demand_of_each_month() -> None:
    """30 June and 1 July, by the standard time of a site two hours east of Greenwich."""
    months = [0.0] * 5 + [100.0, 300.0] + [0.0] * 5
    site = replace(read_site(HOUSE, {"monthly_other_demand": months}), tau=600.0, utc_offset=2.0)
    first = datetime(2021, 6, 30, tzinfo=timezone(timedelta(hours=2)))
    run = run_in(weather_of([0.0] * 48, first=first), site, 5.0, site.x2_star, **CLOSED)
    metrics, ticks = simulate(run, every=1)
    assert ticks is not None and ticks.other is not None
    assert metrics["other_m3"] == pytest.approx(0.4)
    np.testing.assert_allclose(ticks.other[[0, 143, 144, 287]] * 86400, [0.1, 0.1, 0.3, 0.3])


def test_demand_of_a_column(tmp_path: Path) -> None:
    """It replaces that of the site; without the site's key, other uses draw nothing."""
    rows = [f"2021-07-01T{hour:02}:00Z,0,2,{hour}" for hour in range(24)]
    header = "time,precipitation [mm/h],evapotranspiration [mm/day],other demand [l/h]"
    file = tmp_path / "weather.csv"
    file.write_text("\n".join([header, *rows, ""]))

    def run(site: Site) -> dict[str, float]:
        return gr.simulate(
            "onoff", site=site, weather=file, start="2021-07-01T00:00Z", outlet="closed", hours=23,
        ).metrics

    drawn = run(read_site(HOUSE, {"other_demand": 1.0}))
    assert drawn["other_m3"] == pytest.approx(sum(range(23)) / 1000)
    with pytest.warns(UserWarning, match="column other demand is not used"):
        assert "other_m3" not in run(read_site(HOUSE))


def test_a_plan_keeps_what_other_uses_will_need() -> None:
    """Before a storm of 24 mm that a cistern with 5 m3 cannot hold, without more wet discharge."""
    rain, found = [0.0] * 24 + [8.0] * 3 + [0.0] * 12, []
    for demand in (0.0, 1000.0):
        site = replace(read_site(HOUSE, {"other_demand": demand}), tau=600.0)
        found.append(simulate(run_in(weather_of(rain), site, 5.0, site.x2_star, outlet="plan"))[0])
    without, with_demand = found
    assert with_demand["wet_discharge_m3"] == pytest.approx(without["wet_discharge_m3"], abs=0.01)
    assert with_demand["final_cistern_m3"] > without["final_cistern_m3"] + 5
    assert without["outflow_m3"] > 8 and with_demand["outflow_m3"] < 1
