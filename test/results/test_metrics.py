"""Metrics of a run and of its rain events: by hand, and what holds of any run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import datetime
from typing import NamedTuple

import numpy as np
import polars
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE, metrics_of, run_of_hours, site_with

from greenroof_ros.physics.parameters import Flows, State
from greenroof_ros.physics.storm_water import Event, connected_area
from greenroof_ros.results.metrics import Metrics, Results
from greenroof_ros.results.table import event_rows, format_events
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site

STILL, END = Flows(0.0, 0.0, 0.0, 0.0, False, 0.0, 0.0, 0.0, 0.0), State(50.0, 1.0, 0.0)


class Tick(NamedTuple):
    """A tick; rain in m/s, potential evapotranspiration in m3/s."""

    flows: Flows = STILL
    rain: float = 0.0
    command: float = 0.0
    state: State = END
    potential: float = 0.0


def summed(
    site: Site, ticks: Iterable[Tick], end: State = END, start: str = "2021-07-07T00:00-05:00",
) -> Results:
    """Add up ticks.

    Args:
        site: the site.
        ticks: the ticks.
        end: state after them.
        start: time of the first tick.
    """
    ticks = list(ticks)
    time = datetime.fromisoformat(start).timestamp()
    metrics = Metrics(site, len(ticks), time)
    for flows, rain, command, state, potential in ticks:
        metrics.add(state, command, rain, potential, flows)
    return metrics.results(end)


TARGET, FULL = PAPER_SITE.x2_star, 0.00842205211502804
"""of Table I: the roof's target (m3), and the pumps' maximum flow from a level of 3 m (m3/s)"""


def at(roof: float, cistern: float = 50.0) -> State:
    """Return a state without a drainage layer."""
    return State(cistern, roof, 0.0)


def test_sums_by_hand() -> None:
    """Two ticks of 2 s and the end; the target is 3.14416 m3, and 0.157208 m3 from it is near.

    The cistern's inlet has 0.305^2 pi = 0.2922467 m2, the bed 68.8 m2.
    """
    results = summed(site_with(tau=2.0), [
        Tick(Flows(0.1, 0.004, 0.001, 2e-4, False, 0.0, 0.0, 0.0, 0.0), 1e-6, 0.5, at(3.0, 60.0)),
        Tick(Flows(0.0, 0.0, 0.002, 1e-4, True, 0.0, 0.0, 0.0, 0.0), 0.0, 1.25, at(3.5)),
    ], at(3.2, 40.0)).metrics
    expected = {
        "total_deviation_m3": 0.14416 + 0.35584 + 0.05584, "near_target_hours": 2 / 3600,
        "pumped_m3": 0.008, "outflow_m3": 0.2, "drainage_m3": 0.006,
        "evapotranspiration_m3": 6e-4, "rain_roof_m3": 1.376e-4, "rain_cistern_m3": 5.844933e-7,
        "rain_m3": 1.3818449e-4, "max_command": 1.25, "beyond_hours": 2 / 3600,
        "pump_hours": 2 / 3600, "final_cistern_m3": 40.0, "final_roof_m3": 3.2,
        "limited_steps": 1, "pump_starts": 1, "busiest_hour_starts": 1, "excess_starts": 0,
    }
    assert {name: results[name] for name in expected} == pytest.approx(expected, rel=1e-6)
    # There is no valve, and no layer.
    assert not {"mains_m3", "demand_met_share", "final_layer_m3"} & results.keys()


@pytest.mark.parametrize("tau", [3600.0, 7.2])
def test_no_time_exceeds_the_run(tau: float) -> None:
    """A day at the target is 24 h near it, and a day without water 24 h of stress."""
    for roof, name in ((TARGET, "near_target_hours"), (0.0, "stress_hours")):
        ticks = [Tick(state=at(roof))] * round(86_400 / tau)
        assert summed(replace(PAPER_SITE, tau=tau), ticks, at(roof)).metrics[name] == (
            pytest.approx(24.0, rel=1e-12)
        )


@pytest.mark.parametrize(("gap", "busiest"), [(1800, 20), (1799, 21)])
def test_an_hour_holds_its_first_start_no_more(gap: int, busiest: int) -> None:
    """Twenty starts 180 s apart fill it; the next comes as the first leaves. Ticks of 0.1 s."""
    runs = Tick(STILL._replace(pump=0.004), command=1.0, state=at(1.0, 75.0))
    results = summed(site_with(tau=0.1), [runs, *[Tick()] * (gap - 1)] * 30).metrics
    assert results["pump_starts"] == 30
    assert results["busiest_hour_starts"] == busiest
    assert results["excess_starts"] == (10 if busiest > 20 else 0)


# The pumps deliver 0.00842205 m3/s at most (3 m): they run above 8.422e-5 m3/s, or above 1 % of the
# commanded flow.
@pytest.mark.parametrize(("command", "flows", "starts", "ticks"), [
    (1, [0.008 * 0.5**k for k in range(1100)], 1, 7),  # a lag, to 0: 0.008 / 2^6 is 1.25e-4
    (1, [0.004, 2.5e-323, 0.004, 2.5e-323], 2, 2),
    (1, [1e-6 * (k % 2) for k in range(100)], 0, 0),  # the noise of a flow meter
    (1, [8.42e-5, 8.43e-5, 8.42e-5], 1, 1),
    (1e-3, [1e-3 * FULL, 1e-3 * FULL, 0.0, 1e-3 * FULL, 1e-6 * FULL], 2, 3),
])
def test_what_is_treated_as_running(
    command: float, flows: list[float], starts: int, ticks: int
) -> None:
    results = summed(site_with(tau=1.0), [
        Tick(STILL._replace(pump=flow), 0.0, command, at(1.0, 75.0)) for flow in flows
    ]).metrics
    assert results["pump_starts"] == starts
    assert results["pump_hours"] == pytest.approx(ticks / 3600)
    assert results["pumped_m3"] == pytest.approx(sum(flows))


HEAD = 55.2 - 5.78e5 * FULL**2
"""At 3 m the pumps deliver their maximum flow at L = phi = 14.2 m."""


def test_energy_and_starts_by_hand() -> None:
    """Half the flow needs 13 m plus a quarter of the 1.2 m of friction, with 9810 N/m3.

    A quarter of the electric energy becomes hydraulic.
    """
    results = summed(site_with(pump_efficiency=0.25), [
        Tick(STILL._replace(pump=flow), 0.0, 1.0, at(1.0, 75.0))
        for flow in (FULL, FULL, 0.0, FULL / 2, 0.0, 0.0, FULL)
    ]).metrics
    joules = 9810 * (3 * FULL * HEAD + FULL / 2 * (13 + (HEAD - 13) / 4))
    assert results["hydraulic_energy_kwh"] == pytest.approx(joules / 3.6e6, rel=1e-9)
    assert results["electric_energy_kwh"] == pytest.approx(4 * joules / 3.6e6, rel=1e-9)
    assert results["pump_starts"] == 3


def test_pumps_that_stop_within_a_tick() -> None:
    """In ticks of a minute, half of the commanded flow is half a minute if the pumps stop in it.

    The first two cannot reach the target, 3.14416 m3: a meter that reads less is no shorter run.
    While they run they have the head of the full flow.
    """
    results = summed(replace(PAPER_SITE, tau=60.0), [
        Tick(STILL._replace(pump=FULL / 2), 0.0, 1.0, at(x2, 75.0)) for x2 in (1.0, 2.0, 2.7)
    ]).metrics
    assert (results["pump_hours"], results["pump_starts"]) == (pytest.approx(150 / 3600), 1)
    joules = 9810 * 60 * FULL / 2 * (2 * (13 + (HEAD - 13) / 4) + HEAD)
    assert results["hydraulic_energy_kwh"] == pytest.approx(joules / 3.6e6, rel=1e-9)


# 25 m2 of cistern with the mains' valve at 1 m, in ticks of 2 s.
MAINS = site_with(tau=2.0, mains_level=1.0, mains_flow=0.001)


@pytest.mark.parametrize(("first", "last", "mains", "pumped", "outflow", "share"), [
    # 6 of 8 litres did not come from the mains, and fell as rain; a cistern that pumps nothing has
    # no such share.
    (60.0, 60.0, 2e-3, 8e-3, 0.0, 0.75), (60.0, 60.0, 2e-3, 0.0, 0.0, None),
    # What the mains filled into the cistern for later was not pumped; nor was rain that filled it.
    (24.0, 24.002, 4e-3, 4e-3, 0.0, 0.5), (20.0, 25.0, 1e-3, 8e-3, 0.0, 1.0),
    # Water that was there at the start is no rain of the run: 2 of 8 litres, above or below 1 m.
    (60.002, 60.0, 0.0, 8e-3, 0.0, 0.75), (20.002, 20.0, 0.0, 8e-3, 0.0, 0.75),
    (60.002, 60.0, 0.0, 8e-3, 1e-3, 0.875),  # half of it may have flowed to the sewer
])
def test_mains_water_by_hand(
    first: float, last: float, mains: float, pumped: float, outflow: float, share: float | None
) -> None:
    flows = STILL._replace(mains=mains / 2, pump=pumped / 2, outflow=outflow / 2)
    tick = Tick(flows, rain=0.02, state=at(1.0, first))  # 12 litres on the inlet
    results = summed(MAINS, [tick], at(1.0, last)).metrics
    assert results["mains_m3"] == pytest.approx(mains, rel=1e-12)
    assert results.get("demand_met_share") == (share and pytest.approx(share, abs=1e-9))


# A cistern of 14 m3 up to 3 m, with the mains' valve at 1 m.
FILLED = replace(PAPER_SITE, a1=14 / 3, a_in=300.0, tau=3600.0, mains_level=1.0, mains_flow=2e-4)


@settings(max_examples=25)
@given(
    cistern=st.floats(0.0, 18.0),
    rain=st.lists(st.just(0.0) | st.floats(0.0, 20.0), min_size=1, max_size=10),
    dry_days=st.integers(1, 8),
)
@example(14.0, [0.0], 30)
@example(0.0, [4.0], 8)
def test_what_is_in_the_cistern_at_the_start_is_no_rain(
    cistern: float, rain: list[float], dry_days: int
) -> None:
    """In thirty dry days no demand is met with rain, and never less than none or more than all."""
    hours = [*((depth, 4.0, False) for depth in rain), *[(0.0, 4.0, False)] * (24 * dry_days)]
    results = metrics_of(run_of_hours(hours, cistern, 2.0, FILLED))
    share = results.get("demand_met_share")
    assert (share is None) == (results["pumped_m3"] == 0)
    if share is not None:
        assert -1e-9 <= share <= 1
        assert sum(rain) > 0 or share == pytest.approx(0.0, abs=1e-9)


def test_water_that_is_pumped_twice_is_no_rain() -> None:
    """Without rain, no share of what drains back into the cistern is rain, whatever it held."""
    site = replace(FILLED, drainage_to_cistern=1.0)
    for cistern in (14.0, 0.7):
        results = metrics_of(run_of_hours([(0.0, 1.0, False)] * 720, cistern, 2.0, site))
        assert results["pumped_m3"] > 0
        assert results["demand_met_share"] == 0


def test_no_energy_is_negative() -> None:
    """A narrow overflow lets the water rise above the roof, to which it then flows by itself."""
    site = replace(PAPER_SITE, a1=0.5, z_o=1.0, r_o=0.005, d=1.4, a_in=300.0, tau=60.0, c_hat=1.0)
    run = run_of_hours([(100.0, 0.0, False)] * 3, 0.5, 2.0, site)
    levels = [tick.cistern_level for tick in Simulation(run).ticks()]
    assert max(levels) > site.d
    assert metrics_of(run)["hydraulic_energy_kwh"] >= 0


def test_an_owners_metrics_by_hand() -> None:
    """Ticks of 2 s: 0.1 m3 above the target, 0.3 below, empty twice, and 0.2 above at the end.

    The mean of 0.1, 0.3, 3.14416, 3.14416 and 0.2 m3 is 1.377664 m3, 20.0242 mm on 68.8 m2.
    """
    results = summed(site_with(tau=2.0), [
        Tick(STILL._replace(evapotranspiration=actual), state=at(roof), potential=4e-6)
        for roof, actual in ((TARGET + 0.1, 4e-6), (TARGET - 0.3, 2e-6), (0.0, 1e-6), (0.0, 0.0))
    ], at(TARGET + 0.2)).metrics
    assert results["mean_deviation_mm"] == pytest.approx(1377.664 / 68.8, rel=1e-12)
    assert results["near_target_hours"] == pytest.approx(2 / 3600, rel=1e-12)  # 5 % are 0.157 m3
    assert results["stress_hours"] == pytest.approx(4 / 3600, rel=1e-12)
    assert results["evapotranspiration_ratio"] == pytest.approx(7 / 16, rel=1e-12)
    assert "roof_retention_share" not in results  # nothing arrived


def test_stress_is_the_soils() -> None:
    """34.4 m3 of soil with 30 % at field capacity, 10 % at wilting: stress below 20 %, 6.88 m3."""
    site = replace(
        PAPER_SITE, tau=3600.0, z_cap=10.32, field_capacity=0.3, wilting_point=0.1,
        depletion_fraction=0.5,
    )
    ticks = [Tick(state=at(x2)) for x2 in (12.0, 6.8801, 6.8799, 3.0, 0.0)]
    results = summed(site, ticks, at(12.0)).metrics
    assert results["stress_hours"] == 3
    assert "evapotranspiration_ratio" not in results  # there was no demand


@pytest.mark.parametrize(("rain", "pumped", "drained", "share"), [
    # Of 5.7 m3 on the roof 2.6 drain; without irrigation, of 2 m3 of rain a quarter.
    (4.5, 1.2, 2.6, 3.1 / 5.7), (2.0, 0.0, 0.5, 0.75),
    # Half as much again as arrived drains from what was there; if nothing arrived, there is no
    # share.
    (0.4, 0.2, 0.9, -0.5), (0.0, 0.0, 0.3, None),
])
def test_retention_of_the_roof_by_hand(
    rain: float, pumped: float, drained: float, share: float | None
) -> None:
    """On 100 m2, in ticks of ten minutes: it rains in the first, the next two pump and drain."""
    site = site_with(a2=100.0, tau=600.0)
    results = summed(site, [
        Tick(rain=rain / 100 / 600),
        Tick(STILL._replace(pump=pumped / 600)), Tick(STILL._replace(drainage=drained / 600)),
    ]).metrics
    assert results.get("roof_retention_share") == (share and pytest.approx(share, rel=1e-9))


# --- what reaches the sewer, event by event ------------------------------------------------------

# 100 m2 in all, in ticks of five minutes, which are the intervals of events.
SITE = site_with(a_in=50.0, a2=50.0, tau=300.0)
PER_HOUR = 12
PEAKS = [f"peak_discharge_{minutes}min_l_s" for minutes in (5, 15, 60)]


def ticks_of(
    site: Site, count: int, rain: dict[int, float], discharge: dict[int, float]
) -> Iterable[Tick]:
    """Return ticks with rain in mm and discharge in m3, by number."""
    return (
        Tick(
            STILL._replace(outflow=discharge.get(k, 0.0) / site.tau),
            rain.get(k, 0.0) / 1000 / site.tau,
        ) for k in range(count)
    )


def events_of(
    hours: float, rain: dict[int, float], discharge: dict[int, float] | None = None,
    site: Site = SITE,
) -> list[Event]:
    """Return the events of a run with rain in mm and discharge in m3, by five minutes."""
    return summed(site, ticks_of(site, round(hours * PER_HOUR), rain, discharge or {})).events


@pytest.mark.parametrize(("tau", "count", "discharge", "peaks"), [
    # 0.3 m3 in five minutes are 1 L/s; over 15 minutes a third of it, over an hour 0.5 m3.
    (300.0, 24, {5: 0.3, 14: 0.2}, [1.0, 1 / 3, 0.5 / 3.6]),
    (3600.0, 2, {0: 0.3, 1: 0.2}, [0.3 / 3.6] * 3),  # in an hour it is constant
    # Five minutes with 0.06 m3 each, wherever the run's own five minutes are.
    *(
        (60.0, 60, dict.fromkeys(range(first, first + 5), 0.06), [1.0, 1 / 3, 1 / 12])
        for first in range(20, 25)
    ),
    # In 63 s 0.63 m3, 10 L/s, 0.315 m3 before, and 174 s of 0.126 m3 in 63 s; 1.323 m3 in all.
    (63.0, 9, {1: 0.126, 2: 0.126, 3: 0.126, 4: 0.315, 5: 0.63}, [4.31, 1.47, 0.3675]),
    # What is before and after a run counts as none.
    (300.0, 2, {0: 0.6, 1: 0.3}, [2.0, 1.0, 0.25]),
])
def test_peaks_by_hand(
    tau: float, count: int, discharge: dict[int, float], peaks: list[float]
) -> None:
    site = replace(SITE, tau=tau)
    results = summed(site, ticks_of(site, count, {}, discharge)).metrics
    assert [results[name] for name in PEAKS] == pytest.approx(peaks)


def test_events_by_hand() -> None:
    """Two storms six hours and five minutes apart; the second one's peak comes 15 minutes late."""
    begin = 6 * PER_HOUR
    second = begin + 6 + 6 * PER_HOUR + 1
    first, other = events_of(
        26, {begin: 2.0, begin + 6: 4.0, second: 6.0, second + 1: 3.0}, {
            begin + 7: 0.3, begin + 7 + 2 * PER_HOUR: 0.7, second + 3: 0.09, second + 90: 5.0,
        },
    )
    assert (first.start_h, first.hours) == pytest.approx((6.0, 7 / 12))
    assert first.rain_mm == pytest.approx(6.0)
    assert first.max_rain_5min_mm_h == pytest.approx(48.0)
    assert first.max_rain_60min_mm_h == pytest.approx(6.0)
    # Of 0.6 m3 on 100 m2, 0.3 reached the sewer; the peak was 1 L/s of 4 mm in 300 s, 1.333 L/s.
    # The 0.7 m3 came more than two hours after the rain, in dry weather.
    assert (first.discharge_m3, first.wet_discharge_m3) == pytest.approx((1.0, 0.3))
    assert (first.volume_reduction, first.peak_reduction) == pytest.approx((0.5, 0.25))
    # 1 L/s on 100 m2 are 36 mm/h.
    assert (first.peak_l_s, first.peak_mm_h) == pytest.approx((1.0, 36.0))
    assert first.peak_delay_min == pytest.approx(5.0)
    # What is let out more than six hours after the rain does not belong to it.
    assert (other.discharge_m3, other.volume_reduction) == pytest.approx((0.09, 0.9))
    assert other.peak_delay_min == pytest.approx(15.0)
    assert first.complete and other.complete


@pytest.mark.parametrize(("separation", "rain", "events"), [
    # Six dry hours separate, five hours and 55 minutes do not; 0.09 mm are no event.
    (6.0, {2: 1.0, 74: 1.0}, 1), (6.0, {2: 1.0, 75: 1.0}, 2), (6.0, {2: 0.05, 40: 0.05}, 1),
    (6.0, {2: 0.09}, 0), (6.0, {}, 0), (1.0, {2: 1.0, 14: 1.0}, 1), (1.0, {2: 1.0, 15: 1.0}, 2),
])
def test_what_is_one_event_or_none(separation: float, rain: dict[int, float], events: int) -> None:
    site = replace(SITE, event_separation=separation)
    assert len(events_of(10, rain, {2: 1.0}, site)) == events


@pytest.mark.parametrize(("rain", "complete"), [
    # Of 16 hours, six are dry before and after the rain, or five minutes less.
    ({72: 1.0, 119: 1.0}, [True]), ({71: 1.0, 119: 1.0}, [False]), ({72: 1.0, 120: 1.0}, [False]),
    ({0: 1.0}, [False]), ({191: 1.0}, [False]), ({10: 1.0, 83: 1.0}, [False, True]),
    # A trace in the dry hours is rain, although it is no event.
    ({71: 0.09, 144: 1.0}, [False]), ({1: 0.01, 100: 1.0}, [True]),
])
def test_events_that_the_run_cuts(rain: dict[int, float], complete: list[bool]) -> None:
    events = events_of(16, rain)
    assert [event.complete for event in events] == complete
    assert events[-1].max_rain_60min_mm_h == pytest.approx(1.0)  # nothing is known of the next hour


# Ticks of ten minutes on 68.8 + 31.2 m2: 6 mm fall in the first hour. A quarter of the drainage
# flows into the cistern.
VALVE = site_with(
    tau=600.0, a_in=31.2, low_outlet_level=1.0, low_outlet_radius=0.01, drainage_to_cistern=0.25
)
FLOWS = [
    *[Tick(STILL._replace(outflow=1e-4, low_outlet=6e-5, drainage=4e-5), 1e-3 / 600)] * 6,
    *[Tick(STILL._replace(outflow=2e-5, low_outlet=2e-5))] * 30,
]


def test_storm_water_by_hand() -> None:
    """0.828 m3 left, more than the 0.6 m3 of rain: 38 % more, and that is not cut off."""
    results, (event,) = summed(VALVE, FLOWS)
    expected = {
        "discharge_m3": 3600 * (1e-4 + 0.75 * 4e-5) + 18000 * 2e-5,
        # An hour of rain, and two after it.
        "wet_discharge_m3": 3600 * (1e-4 + 0.75 * 4e-5) + 7200 * 2e-5,
        "peak_discharge_5min_l_s": 0.13, "peak_discharge_60min_mm_h": 0.13 * 3600 / 100,
        "overflow_m3": 3600 * 4e-5, "overflow_days": 1, "retention_share": -0.38,
    }
    assert {name: results[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    assert event.wet_discharge_m3 == pytest.approx(0.612)
    assert event.volume_reduction == pytest.approx(1 - 0.612 / 0.6)
    assert event.peak_reduction == pytest.approx(1 - 0.13 / (1e-3 / 600 * 100 * 1000))


def test_a_run_of_no_tick() -> None:
    """There is no share of nothing; all else is 0."""
    results, events = summed(SITE, [])
    assert "retention_share" not in results and events == []
    assert {results[name] for name in (*PEAKS, "discharge_m3", "overflow_m3")} == {0.0}


@pytest.mark.parametrize(("start", "zone", "hours", "days"), [
    # The site's clock counts, not that of the start: 02:00-05:00 is 07:00 UTC.
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(17), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(18), 2),
    # The day on which clocks are set back has 25 hours, and it is midnight twice in Havana.
    ("2021-11-07T00:00-04:00", {"time_zone": "America/Havana"}, range(25), 1),
    ("2021-11-07T00:00-04:00", {"time_zone": "America/Havana"}, range(26), 2),
])
def test_overflow_days_are_calendar_days(
    start: str, zone: dict[str, object], hours: range, days: int
) -> None:
    site = replace(site_with(tau=600.0), **zone)  # type: ignore[arg-type]
    overflows = STILL._replace(outflow=1e-4)
    ticks = [Tick(overflows if k // 6 in hours else STILL) for k in range(6 * 150)]
    results = summed(site, ticks, start=start).metrics
    assert results["overflow_days"] == days
    assert results["overflow_m3"] == pytest.approx(0.36 * len(hours))


def test_the_last_drops_are_no_overflow() -> None:
    """0.1 mm over 100 m2 are 10 l: 9.9 l on the first day do not count, 10.1 l on the next do."""
    for discharge, days in (({0: 0.0099}, 0), ({0: 0.0099, 288: 0.0101}, 1)):
        results = summed(SITE, ticks_of(SITE, 576, {}, discharge)).metrics
        assert results["overflow_days"] == days


DRAWN = st.lists(
    st.tuples(
        st.just(0.0) | st.floats(2e-6, 1e-4), st.just(0.0) | st.floats(1e-7, 1e-2),
        st.integers(1, 60),
    ),
    min_size=1, max_size=12,
)


@given(
    tau=st.sampled_from([60.0, 300.0, 420.0, 600.0]), wet_after=st.floats(0.0, 5.8),
    separation=st.floats(6.0, 12.0), drawn=DRAWN,
)
@example(60.0, 2.0, 6.0, [(3e-6, 1e-3, 1), (0.0, 1e-3, 60)])
def test_any_run(
    tau: float, wet_after: float, separation: float, drawn: list[tuple[float, float, int]]
) -> None:
    """All discharge is in one event or between two, and no peak is above a shorter one.

    That in wet weather is all in events.
    """
    site = replace(SITE, tau=tau, wet_after=wet_after, event_separation=separation)
    ticks = [
        Tick(STILL._replace(outflow=outflow, drainage=outflow / 3), rain)
        for rain, outflow, count in drawn for _ in range(count)
    ]
    results, events = summed(site, ticks)
    dry = round(separation * 3600 / tau)
    during = np.zeros(len(ticks), bool)
    first = 0
    for event in events:
        begins = round(event.start_h * 3600 / tau)
        ends = begins + round(event.hours * 3600 / tau) + dry
        assert begins >= first
        during[begins:ends], first = True, ends
    discharge = tau * np.array([tick.flows.outflow + tick.flows.drainage for tick in ticks])
    total = results["discharge_m3"]
    assert total == pytest.approx(discharge.sum(), rel=1e-9)
    assert sum(event.discharge_m3 for event in events) + discharge[~during].sum() == pytest.approx(
        total, rel=1e-9, abs=1e-12
    )
    assert sum(event.wet_discharge_m3 for event in events) == pytest.approx(
        results["wet_discharge_m3"], rel=1e-9, abs=1e-12
    )
    five, fifteen, sixty = (results[name] for name in PEAKS)
    assert five * (1 + 1e-9) + 1e-12 >= fifteen
    assert fifteen * (1 + 1e-9) + 1e-12 >= sixty
    rain = sum(tick.rain for tick in ticks) * tau * connected_area(site)
    assert results.get("retention_share") == (pytest.approx(1 - total / rain) if rain else None)
    for event in events:
        assert 0 <= event.wet_discharge_m3 <= event.discharge_m3 * (1 + 1e-9)
        assert event.max_rain_60min_mm_h <= event.max_rain_5min_mm_h * (1 + 1e-9)
        assert event.peak_l_s <= five * (1 + 1e-9) + 1e-12
        assert max(event.volume_reduction, event.peak_reduction) <= 1
        assert (event.peak_delay_min is None) == (event.wet_discharge_m3 <= 1e-9)


EVENT = Event(
    start_h=23.25, hours=1 / 3, rain_mm=6.1, max_rain_5min_mm_h=48.0, max_rain_60min_mm_h=6.1,
    discharge_m3=0.3, wet_discharge_m3=0.1, peak_l_s=1e-9, peak_mm_h=36.0, volume_reduction=-2.5,
    peak_reduction=0.25, peak_delay_min=None, complete=False,
)


def test_events_in_a_file() -> None:
    """To the bit, as polars reads them; 23.25 h after 02:00 is 01:15 of the next day."""
    rows = event_rows(datetime.fromisoformat("2021-07-07T02:00-05:00"), [
        EVENT, EVENT._replace(peak_delay_min=5.0, complete=True),
    ])
    assert rows[0]["start"] == "2021-07-08T01:15:00-05:00"
    frame = polars.read_csv(format_events(rows).encode())
    assert frame["complete"].to_list() == [False, True]
    assert frame["peak_delay_min"].to_list() == [None, 5.0]
    assert frame.select(Event._fields).rows()[0] == tuple(EVENT)
