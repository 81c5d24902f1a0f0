"""A time without an offset is the wall clock of the site's zone, or else of the data frame's."""

from __future__ import annotations

from datetime import datetime

import polars
import pytest
from places import refusal

import greenroof_ros as gr
from greenroof_ros.site.site import Site

PAPERS = gr.read_site()
BERLIN = gr.read_site(time_zone="Europe/Berlin", utc_offset=1.0, latitude=52.5, longitude=13.4)


def weather(first: str, zone: str | None) -> polars.DataFrame:
    """Three days from midnight UTC on, an hour of n mm after n hours, in a zone's times."""
    times = polars.datetime_range(
        datetime.fromisoformat(first), polars.lit(datetime.fromisoformat(first)) + polars.duration(
            hours=71), "1h", time_zone="UTC", eager=True,
    ).dt.convert_time_zone(zone or "Europe/Berlin")
    return polars.DataFrame({
        "rain [mm]": [float(hour) for hour in range(72)], "temperature [degC]": [20.0] * 72,
        "my evapotranspiration [mm/day]": [3.0] * 72,
        "time": times if zone else times.dt.replace_time_zone(None),
    })


@pytest.mark.parametrize(("site", "zone"), [
    (BERLIN, None), (BERLIN, "Europe/Berlin"), (BERLIN, "UTC"), (BERLIN, "Asia/Kolkata"),
    (PAPERS, "Europe/Berlin"),
])
@pytest.mark.parametrize(("first", "start", "hour"), [
    ("2024-06-30", "2024-07-01T01:00:00+02:00", 23),
    ("2024-12-31", "2025-01-01T01:00:00+01:00", 24),
    # Clocks change at 01:00 UTC of the second day. What they show twice is the first.
    ("2024-03-30", "2024-03-31T01:00:00+01:00", 24),
    ("2024-03-30", "2024-03-31T03:00:00+02:00", 25),
    ("2024-10-26", "2024-10-27T02:00:00+02:00", 24),
    ("2024-10-26", "2024-10-27T03:00:00+01:00", 26),
])
@pytest.mark.filterwarnings("ignore")
def test_the_first_tick_has_the_rain_of_its_hour(
    site: Site, zone: str | None, first: str, start: str, hour: int
) -> None:
    """Hours are counted by hand; the trajectory has the site's zone, in a bag, too."""
    result = gr.simulate(
        "onoff", site=site, weather=weather(first, zone), start=start[:-6], hours=0.01
    )
    assert result.run.start.isoformat() == start
    assert 3.6e6 * result.ticks.precipitation[0] == pytest.approx(hour)
    if site is BERLIN:
        assert result.trajectory["time"][0].isoformat() == start
        assert result.trajectory.schema["time"].time_zone == "Europe/Berlin"


def test_a_time_that_clocks_skip_is_refused() -> None:
    refusal(
        lambda: gr.simulate("onoff", site=BERLIN, weather=weather("2024-03-30", "UTC"),
                            start="2024-03-31T02:30"),
        match="start = '2024-03-31T02:30': is a time that the clocks in Europe/Berlin skip",
    )
    naive = weather("2024-03-30", "UTC").with_columns(
        polars.col("time").dt.replace_time_zone(None)
    )
    refusal(
        lambda: gr.simulate("onoff", site=BERLIN, weather=naive),
        match="^the data frame, row 26: time = '2024-03-31 02:00.*clocks in Europe/Berlin skip",
    )


@pytest.mark.parametrize(("start", "expected"), [
    ("2021-07-07T02:00", "2021-07-07T02:00:00-04:00"),  # Toronto in summer
    ("2021-07-07T02:00-05:00", "2021-07-07T02:00:00-05:00"),
    ("2021-07-08T02:00Z", "2021-07-08T02:00:00+00:00"),
])
@pytest.mark.filterwarnings("ignore")
def test_start_in_the_zone_of_the_site(start: str, expected: str) -> None:
    site = gr.read_site(time_zone="America/Toronto")
    run = gr.simulate("onoff", hours=0.01, site=site, start=start).run
    assert run.start.isoformat() == expected
