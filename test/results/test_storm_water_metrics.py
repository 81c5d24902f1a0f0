"""What reaches the sewer, event by event: by hand, and what holds of any run."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from paper import site_with
from summed import STILL, Tick, summed

from greenroof_ros.physics.storm_water import Event, connected_area
from greenroof_ros.site.site import Site

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
    # In an hour it is constant.
    (3600.0, 2, {0: 0.3, 1: 0.2}, [0.3 / 3.6] * 3),
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
    # A day of the run that begins at 02:00 has two calendar days.
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, range(22), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": -5.0}, range(23), 2),
    # The site's clock counts, not that of the start: 02:00-05:00 is 07:00 UTC.
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(17), 1),
    ("2021-07-07T02:00-05:00", {"utc_offset": None}, range(18), 2),
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
