"""What reaches the sewer, event by event: by hand, and what holds of any run."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from paper import PAPER_SITE, run_of_hours, site_with

from greenroof_ros.physics.plant import Flows, Plant
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.physics.storm_water import (
    Intervals,
    connected_area,
    find_events,
    find_peak,
    find_wet_weather,
    interval_seconds,
)
from greenroof_ros.results.metrics import Metrics, Samples, events_of, totals_of
from greenroof_ros.results.virtual_site import VirtualSite
from greenroof_ros.simulation.loop import Simulation
from greenroof_ros.site.site import Site

# 100 m2 in all.
SITE = site_with(a_in=50.0, a2=50.0)
PER_HOUR = 12
PEAKS = [f"peak_discharge_{minutes}min_l_s" for minutes in (5, 15, 60)]


def intervals(
    hours: float, rain: dict[int, float], discharge: dict[int, float], seconds: float = 300.0
) -> Intervals:
    """Return sums of intervals: rain in mm and discharge in m3, by index."""
    count = round(hours * 3600 / seconds)
    result = Intervals(seconds, np.zeros(count), np.zeros(count))
    for at, depth in rain.items():
        result.rain[at] = depth / 1000
    for at, volume in discharge.items():
        result.discharge[at] = volume
    return result


def wet(hours: float, rain: dict[int, float], site: Site = SITE) -> list[int]:
    """Return the intervals in wet weather."""
    return np.flatnonzero(find_wet_weather(site.wet_after, intervals(hours, rain, {}))).tolist()


def test_wet_weather_is_rain_and_two_hours_after() -> None:
    """0.09 mm in an hour are none; rain within the hour counts from its first five minutes on."""
    assert wet(8, {1: 0.09, 14: 0.06, 20: 0.05}) == list(range(14, 20 + 24 + 1))
    assert wet(8, {1: 0.09}) == wet(8, {}) == []
    assert wet(2, {20: 0.1}) == [20, 21, 22, 23]  # until the run's end
    assert wet(3, {2: 0.1}, replace(SITE, wet_after=0.0)) == [2]
    assert wet(3, {2: 0.1}, replace(SITE, wet_after=0.5)) == list(range(2, 9))


def test_wet_weather_does_not_depend_on_the_runs_start() -> None:
    """0.06 mm in each of two periods of half an hour that meet in a run's hour or at its end."""
    for first in (0, 3, 6, 9):
        rain = dict.fromkeys(range(first, first + 12), 0.01)
        assert wet(6, rain) == list(range(first, first + 12 + 24))
        # Not more than 0.09 mm within any 60 minutes.
        rain = dict.fromkeys(range(first, first + 24), 0.0075)
        assert wet(6, rain) == []


@given(
    st.lists(st.sampled_from([0.0, 0.0, 0.0, 0.01, 0.03, 0.06, 0.2]), min_size=1, max_size=60),
    st.integers(0, 30),
)
def test_wet_weather_one_by_one(depths: list[float], after: int) -> None:
    """Five minutes count if any twelve in a row with them have 0.1 mm; so do those after it."""
    rains = [
        depth > 0 and any(
            sum(depths[max(0, first):first + 12]) > 0.0999 for first in range(at - 11, at + 1)
        )
        for at, depth in enumerate(depths)
    ]
    expected = [any(rains[max(0, at - after):at + 1]) for at in range(len(depths))]
    site = replace(SITE, wet_after=after / 12)
    run = Intervals(300.0, np.array(depths) / 1000, np.zeros(len(depths)))
    assert find_wet_weather(site.wet_after, run).tolist() == expected


def test_hourly_rain_is_wet_for_its_hours() -> None:
    run = Intervals(3600.0, np.array([0, 0.1, 0, 0, 0, 0.09, 0.0]) / 1000, np.zeros(7))
    wet = find_wet_weather(SITE.wet_after, run)
    assert wet.tolist() == [False, True, True, True, False, False, False]


def test_peaks() -> None:
    """0.3 m3 in five minutes are 1 L/s; over 15 minutes a third of it, over an hour 0.5 m3."""
    run = intervals(2, {}, {5: 0.3, 14: 0.2})
    assert 1000 * find_peak(run, 5) == pytest.approx(1.0)
    assert 1000 * find_peak(run, 15) == pytest.approx(1 / 3)
    assert 1000 * find_peak(run, 60) == pytest.approx(0.5 / 3.6)
    # Within an interval of an hour it is constant.
    hourly = Intervals(3600.0, run.rain, run.discharge)
    assert 1000 * find_peak(hourly, 5) == pytest.approx(0.3 / 3.6)


@pytest.mark.parametrize("begins", range(5))
def test_a_peak_may_begin_in_any_minute(begins: int) -> None:
    """Five minutes with 0.06 m3 each, 1 L/s, wherever the run's own five minutes lie."""
    run = intervals(1, {}, dict.fromkeys(range(20 + begins, 25 + begins), 0.06), 60.0)
    assert 1000 * find_peak(run, 5) == pytest.approx(1.0)
    assert 1000 * find_peak(run, 15) == pytest.approx(1 / 3)


def test_windows_that_no_number_of_intervals_fills() -> None:
    """0.63 m3 in 63 s, 10 L/s, and 0.315 m3 before: (0.63 + 0.315 + 174 s of 0.126 m3 in 63 s)."""
    run = Intervals(63.0, np.zeros(9), np.array([0, 0.126, 0.126, 0.126, 0.315, 0.63, 0, 0, 0]))
    expected = 0.63 + 0.315 + 0.002 * 174
    assert find_peak(run, 5) == pytest.approx(expected / 300)
    assert find_peak(run, 1) == pytest.approx(0.01)


def test_a_run_shorter_than_the_window() -> None:
    """What is before and after it counts as none: 0.9 m3 in ten minutes are 0.25 L/s in an hour."""
    run = intervals(1 / 6, {}, {0: 0.6, 1: 0.3})
    assert [1000 * find_peak(run, minutes) for minutes in (5, 15, 60)] == pytest.approx(
        [2.0, 1.0, 0.25]
    )


@pytest.mark.parametrize(("tau", "seconds"), [
    (0.1, 60), (1, 60), (7, 63), (10, 60), (60, 60), (90, 90), (300, 300), (600, 600), (3600, 3600),
])
def test_intervals_are_whole_ticks(tau: float, seconds: float) -> None:
    assert interval_seconds(site_with(tau=tau)) == pytest.approx(seconds)


def test_events_by_hand() -> None:
    """Two storms six hours and five minutes apart; the second one's peak comes 15 minutes late."""
    second = 10 + 6 * PER_HOUR + 1
    run = intervals(
        20, {4: 2.0, 10: 4.0, second: 6.0, second + 1: 3.0},
        {11: 0.3, 11 + 2 * PER_HOUR: 0.7, second + 3: 0.09, second + 90: 5.0},
    )
    first, other = find_events(SITE, run)
    assert (first.start_h, first.hours) == pytest.approx((4 / 12, 7 / 12))
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
    assert first.complete
    assert other.complete


def test_what_is_one_event_or_none() -> None:
    """Six dry hours separate, five hours and 55 minutes do not; 0.09 mm are no event."""
    at = 2 + 6 * PER_HOUR
    assert len(find_events(SITE, intervals(10, {2: 1.0, at: 1.0}, {}))) == 1
    assert len(find_events(SITE, intervals(10, {2: 1.0, at + 1: 1.0}, {}))) == 2
    assert len(find_events(SITE, intervals(10, {2: 0.05, 40: 0.05}, {}))) == 1
    assert find_events(SITE, intervals(10, {2: 0.09}, {})) == []
    assert find_events(SITE, intervals(10, {}, {2: 1.0})) == []
    hourly = replace(SITE, event_separation=1.0)
    assert len(find_events(hourly, intervals(10, {2: 1.0, 14: 1.0}, {}))) == 1
    assert len(find_events(hourly, intervals(10, {2: 1.0, 15: 1.0}, {}))) == 2


def test_an_event_without_discharge() -> None:
    (dry,) = find_events(SITE, intervals(10, {2: 1.0}, {}))
    assert dry.volume_reduction == dry.peak_reduction == 1.0
    assert dry.discharge_m3 == dry.peak_l_s == dry.peak_mm_h == 0.0
    assert dry.peak_delay_min is None


def test_more_discharge_than_rain() -> None:
    """1 mm on 100 m2 is 0.1 m3; 0.3 m3 let out with it are 200 % more, the peak likewise."""
    (event,) = find_events(SITE, intervals(10, {2: 1.0}, {2: 0.3}))
    assert (event.volume_reduction, event.peak_reduction) == pytest.approx((-2.0, -2.0))
    assert event.peak_delay_min == 0.0


@pytest.mark.parametrize(("at", "complete"), [(0, False), (1, True), (47, True), (48, False)])
def test_events_that_the_run_cuts(at: int, complete: bool) -> None:
    """Ten hours: it rains from the start, or six hours and less than five minutes are left."""
    (event,) = find_events(SITE, intervals(10, {at: 1.0}, {at: 0.1}))
    assert event.complete == complete
    assert event.rain_mm == pytest.approx(1.0)
    (late,) = find_events(SITE, intervals(1, {11: 1.0}, {}))
    assert late.max_rain_60min_mm_h == pytest.approx(1.0)  # nothing is known of the next hour


# --- through the metrics of a run -----------------------------------------------------------------

STILL = Flows(0.0, 0.0, 0.0, 0.0, False, 0.0)


def metrics_of(
    site: Site, ticks: list[tuple[float, Flows]], start: str = "2021-07-07T00:00-05:00"
) -> Metrics:
    """Return the metrics of ticks, each with its rain (m/s) and its flows."""
    metrics = Metrics(site, Plant(site, 50.0, 1.0), datetime.fromisoformat(start).timestamp())
    for rain, flows in ticks:
        metrics.step(0.0, rain, 0.0, flows)
    return metrics


@pytest.mark.parametrize("tau", [1.0, 7.0, 10.0, 60.0, 300.0, 600.0])
def test_peaks_for_any_tick(tau: float) -> None:
    """20 minutes with 2 L/s from minute 42 on; ticks that begin in it blur its ends only.

    Over an hour they are 2/3 L/s, less what is lost at most in two ticks at its ends.
    """
    site = site_with(tau=tau)
    flows = [
        STILL._replace(outflow=2e-3 * (42 * 60 <= k * tau < 62 * 60))
        for k in range(int(2 * 3600 / tau))
    ]
    results = metrics_of(site, [(0.0, each) for each in flows]).results()
    assert (results[PEAKS[0]], results[PEAKS[1]]) == pytest.approx((2.0, 2.0))
    assert results[PEAKS[2]] == pytest.approx(2 / 3, abs=2.0 * tau / 3600)
    # On 68.8 + 0.2922467 m2, 2 L/s are 104.2 mm/h.
    assert results["peak_discharge_5min_mm_h"] == pytest.approx(2 * 3600 / 69.0922467)


STORM = [2, 6, 12, 30, 60, 96, 48, 24, 12, 6, 3, 2]


def test_peaks_do_not_depend_on_the_tick() -> None:
    """A storm of an hour in steps of five minutes (mm/h), through an open outlet and past it.

    Ticks up to its steps give the same peaks to 1 %; in longer ones rain is a mean of two steps.
    """
    roof = replace(
        PAPER_SITE, a1=5.0, a_in=270.0, low_outlet_level=0.9, low_outlet_radius=0.012,
        low_outlet_valve=True,
    )
    for outlet, x1 in ((1.0, 4.5), (0.0, 14.9)):
        found: dict[float, dict[str, float]] = {}
        for tau in (10.0, 60.0, 300.0, 600.0):
            site = VirtualSite(replace(roof, tau=tau), x1, 2.7, 0, SensorAndPump())
            for k in range(int(10 * 3600 / tau)):
                steps = STORM[max(0, int(k * tau / 300) - 12):][:max(1, round(tau / 300))]
                rain = sum(steps) / len(steps) if steps and k * tau >= 3600 else 0.0
                site.act(rain / 3.6e6, 0.0, 0.0, outlet=outlet)
                site.step()
            found[tau] = site.metrics.results()
        for tau in (60.0, 300.0):
            for peak in PEAKS:
                assert found[tau][peak] == pytest.approx(found[10.0][peak], rel=0.01)
        assert found[600.0][PEAKS[0]] < 0.99 * found[10.0][PEAKS[0]]
        assert found[600.0]["discharge_m3"] == pytest.approx(found[10.0]["discharge_m3"], rel=0.01)


def test_storm_water_by_hand() -> None:
    """Ticks of ten minutes on 68.8 + 31.2 m2: 6 mm fall in the first hour.

    A quarter of the drainage flows into the cistern.
    """
    site = site_with(
        tau=600.0, a_in=31.2, low_outlet_level=1.0, low_outlet_radius=0.01,
        drainage_to_cistern=0.25,
    )
    rain = 1e-3 / 600
    ticks = [
        *[(rain, STILL._replace(outflow=1e-4, low_outlet=6e-5, drainage=4e-5))] * 6,
        *[(0.0, STILL._replace(outflow=2e-5, low_outlet=2e-5))] * 30,
    ]
    results = metrics_of(site, ticks).results()
    expected = {
        "discharge_m3": 3600 * (1e-4 + 0.75 * 4e-5) + 18000 * 2e-5,
        # An hour of rain, and two after it.
        "wet_discharge_m3": 3600 * (1e-4 + 0.75 * 4e-5) + 7200 * 2e-5,
        "peak_discharge_5min_l_s": 0.13, "peak_discharge_60min_mm_h": 0.13 * 3600 / 100,
        "overflow_m3": 3600 * 4e-5, "overflow_days": 1,
        "retention_share": 0.0,  # 0.828 m3 left, more than the 0.6 m3 of rain
    }
    assert {name: results[name] for name in expected} == pytest.approx(expected, rel=1e-9)
    (event,) = metrics_of(site, ticks).events()
    assert event.wet_discharge_m3 == pytest.approx(0.612)
    assert event.volume_reduction == pytest.approx(1 - 0.612 / 0.6)
    assert event.peak_reduction == pytest.approx(1 - 0.13 / (1e-3 / 600 * 100 * 1000))


def test_no_rain_at_all() -> None:
    """There is no share of nothing; all else is 0."""
    results = metrics_of(SITE, [(0.0, STILL)] * 100).results()
    assert not any(math.isnan(value) for value in results.values())
    assert "retention_share" not in results
    assert {results[name] for name in (*PEAKS, "discharge_m3", "wet_discharge_m3")} == {0.0}
    assert (results["overflow_m3"], results["overflow_days"]) == (0.0, 0)
    assert metrics_of(SITE, [(0.0, STILL)] * 100).events() == []
    assert totals_of(SITE, samples([0.0]))["discharge_m3"] == 0.0  # a run of no tick


OVERFLOWS = STILL._replace(outflow=1e-4)


@pytest.mark.parametrize(("start", "zone", "hours", "days"), [
    # From 20:00 to 02:00; a day of the run that begins at 02:00 has two calendar days.
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, range(18, 24), 2),
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, range(22), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, range(23), 2),
    ("2021-07-07T02:00-05:00", {"utc_offset": -4.0}, range(21), 1),
    # The site's clock counts, not that of the start: 02:00-05:00 is 07:00 UTC.
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(17), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(18), 2),
    # With daylight saving: 00:00-05:00 is 01:00 in Toronto.
    ("2021-07-07T00:00-05:00", {"time_zone": "America/Toronto", "utc_offset": -5.0}, range(23), 1),
    ("2021-07-07T00:00-05:00", {"time_zone": "America/Toronto", "utc_offset": -5.0}, range(24), 2),
    # The day on which clocks are set back has 25 hours, and it is midnight twice in Havana.
    ("2021-11-07T00:00-04:00", {"time_zone": "America/Toronto"}, range(25), 1),
    ("2021-11-07T00:00-04:00", {"time_zone": "America/Toronto"}, range(26), 2),
    ("2021-11-07T00:00-04:00", {"time_zone": "America/Havana"}, range(25), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, (0, 60, 61, 130), 3),
])
def test_overflow_days_are_calendar_days(
    start: str, zone: dict[str, object], hours: range, days: int
) -> None:
    site = replace(site_with(tau=600.0), **zone)  # type: ignore[arg-type]
    ticks = [(0.0, OVERFLOWS if k // 6 in hours else STILL) for k in range(6 * 150)]
    results = metrics_of(site, ticks, start).results()
    assert results["overflow_days"] == days
    assert results["overflow_m3"] == pytest.approx(0.36 * len(hours))


def test_the_last_drops_are_no_overflow() -> None:
    """0.1 mm over 100 m2 are 10 l: 9.9 l on the first day do not count, 10.1 l on the next do."""
    ticks = [(0.0, STILL._replace(outflow=1e-3 * litres / 600)) for litres in (9.9, 10.1)]
    (first, other), dry = ticks, [(0.0, STILL)] * 143
    site = site_with(a_in=50.0, a2=50.0, tau=600.0)
    assert metrics_of(site, [first, *dry]).results()["overflow_days"] == 0
    assert metrics_of(site, [first, *dry, other, *dry]).results()["overflow_days"] == 1


def samples(time: list[float], **values: object) -> Samples:
    """Return samples at these times, the last a second long; all 0 but the given values."""
    zero = np.zeros(len(time))
    given_values = dict.fromkeys((
        "cistern", "roof", "command", "precipitation", "outflow", "pump", "drainage",
        "evapotranspiration", "layer", "potential", "mains", "low_outlet",
    ), zero) | values
    return Samples(  # type: ignore[arg-type]
        duration=np.append(np.diff(time), PAPER_SITE.tau), time=np.array(time), **given_values
    )


def test_samples_that_last_longer_than_an_interval() -> None:
    """A sample of half an hour with 1 L/s is half an hour of 1 L/s, not its water in a minute."""
    kept = samples(
        [0.0, 90.0, 1890.0, 9000.0], outflow=np.array([0.0, 1e-3, 0.0, 0.0]),
        precipitation=np.array([0.0, 1e-6, 0.0, 0.0]),
    )
    results = totals_of(PAPER_SITE, kept)
    assert [results[name] for name in PEAKS] == pytest.approx([1.0, 1.0, 0.5])
    assert (results["discharge_m3"], results["wet_discharge_m3"]) == pytest.approx((1.8, 1.8))
    (event,) = events_of(PAPER_SITE, kept)
    assert event.hours == pytest.approx(31 / 60)  # of whole minutes
    assert event.rain_mm == pytest.approx(1.8)
    assert event.max_rain_5min_mm_h == pytest.approx(3.6)
    assert event.peak_delay_min == pytest.approx(0.0)


def test_unknown_discharge() -> None:
    """Nobody recorded it: there are no metrics of it, instead of the best ones."""
    known = totals_of(PAPER_SITE, samples([0.0, 60.0], precipitation=np.array([1e-4, 0.0])))
    unknown = samples([0.0, 60.0], precipitation=np.array([1e-4, 0.0]), discharge_known=False)
    assert known.keys() - totals_of(PAPER_SITE, unknown).keys() == {
        "discharge_m3", "wet_discharge_m3", "overflow_m3", "overflow_days", "retention_share",
        *(f"peak_discharge_{minutes}min_{unit}" for minutes in (5, 15, 60)
          for unit in ("l_s", "mm_h")),
    }
    assert events_of(PAPER_SITE, unknown) == []


DRAWN = st.lists(
    st.tuples(
        st.just(0.0) | st.floats(1e-8, 1e-4), st.just(0.0) | st.floats(1e-7, 1e-2),
        st.integers(1, 60),
    ),
    min_size=1, max_size=12,
)


@given(
    tau=st.sampled_from([60.0, 300.0, 420.0, 600.0]), wet_after=st.floats(0.0, 6.0),
    separation=st.floats(6.0, 12.0), drawn=DRAWN,
)
@example(60.0, 2.0, 6.0, [(1e-6, 1e-3, 1), (0.0, 1e-3, 60)])
def test_any_run(
    tau: float, wet_after: float, separation: float, drawn: list[tuple[float, float, int]]
) -> None:
    """All discharge is in one event or between two, and no peak is above a shorter one.

    That in wet weather is all in events, unless more of it comes after them.
    """
    site = replace(SITE, tau=tau, wet_after=wet_after, event_separation=separation)
    ticks = [
        (rain, STILL._replace(outflow=outflow, drainage=outflow / 3))
        for rain, outflow, count in drawn for _ in range(count)
    ]
    metrics = metrics_of(site, ticks)
    results, events = metrics.results(), metrics.events()
    dry = round(separation * 3600 / tau)
    during = np.zeros(len(ticks), bool)
    first = 0
    for event in events:
        begins = round(event.start_h * 3600 / tau)
        ends = begins + round(event.hours * 3600 / tau) + dry
        assert begins >= first
        during[begins:ends], first = True, ends
    discharge = tau * np.array([flows.outflow + flows.drainage for _, flows in ticks])
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
    rain = sum(rain for rain, _ in ticks) * tau * connected_area(site)
    assert 0 <= results.get("retention_share", 0) <= 1
    if rain and total <= rain:
        assert results["retention_share"] == pytest.approx(1 - total / rain, abs=1e-9)
    for event in events:
        assert 0 <= event.wet_discharge_m3 <= event.discharge_m3 * (1 + 1e-9)
        assert event.max_rain_60min_mm_h <= event.max_rain_5min_mm_h * (1 + 1e-9)
        assert event.peak_l_s <= five * (1 + 1e-9) + 1e-12
        assert event.volume_reduction <= 1
        assert event.peak_reduction <= 1
        assert (event.peak_delay_min is None) == (event.wet_discharge_m3 <= 1e-9)


def test_retention_of_a_roof_by_its_balance() -> None:
    """What never reached the sewer evaporated, or is in store: rain - discharge by the balance."""
    site = site_with(tau=60.0, a_in=40.0)
    run = run_of_hours([(8.0, 3.0, False)] * 3 + [(0.0, 3.0, False)] * 9, 74.9, 3.0, site)
    simulation = Simulation(run)
    for _ in simulation.ticks():
        pass
    results = simulation.metrics.results()
    stored = results["final_cistern_m3"] + results["final_roof_m3"] - 74.9 - 3.0
    assert results["discharge_m3"] > 0
    assert results["retention_share"] == pytest.approx(
        (results["evapotranspiration_m3"] + stored) / results["rain_m3"], rel=1e-9
    )
