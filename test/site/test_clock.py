"""Quiet hours follow the local clock, also on days on which it changes.

Times in UTC are worked out by hand: Toronto is 5 h behind UTC in winter, 4 h in summer; in 2026 its
clocks went from 02:00 to 03:00 on 8 March, and from 02:00 back to 01:00 on 1 November.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from places import CONFIG

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.times import epoch_ns
from greenroof_ros.site.clock import QuietHours, standard_offset
from greenroof_ros.site.file import read_site

TORONTO = ZoneInfo("America/Toronto")


def ns(utc: str) -> int:
    return epoch_ns(datetime.fromisoformat(f"{utc}+00:00"))


def changes(hours: QuietHours, day: str) -> list[str]:
    """Return the minutes of a day in UTC at which quiet hours begin (+) or end (-)."""
    begin = datetime.fromisoformat(f"{day}T00:00+00:00")
    changes = []
    before = hours.quiet_at(epoch_ns(begin) - 1)
    for minute in range(1440):
        at = begin + timedelta(minutes=minute)
        now = hours.quiet_at(epoch_ns(at))
        if now != before:
            changes.append(f"{'+' if now else '-'}{at:%H:%M}")
        before = now
    return changes


@pytest.mark.parametrize(("interval", "day", "expected"), [
    ("22:00-06:00", "2026-01-15", ["+03:00", "-11:00"]),  # -05:00
    ("20:00-06:00", "2026-07-15", ["+00:00", "-10:00"]),  # -04:00, and not a moment earlier
    # In spring: seven hours of night, and no 02:15.
    ("22:00-06:00", "2026-03-08", ["+03:00", "-10:00"]),
    ("02:15-02:45", "2026-03-08", []),
    ("01:00-02:30", "2026-03-08", ["+06:00", "-07:00"]),
    ("02:30-04:00", "2026-03-08", ["+07:00", "-08:00"]),
    # In autumn: nine hours of night, and 01:15 twice.
    ("22:00-06:00", "2026-11-01", ["+02:00", "-11:00"]),
    ("01:15-01:45", "2026-11-01", ["+05:15", "-05:45", "+06:15", "-06:45"]),
    ("01:30-02:00", "2026-11-01", ["+05:30", "-06:00", "+06:30", "-07:00"]),
])
def test_by_the_clock_on_the_wall(interval: str, day: str, expected: list[str]) -> None:
    assert changes(QuietHours([interval], TORONTO), day) == expected


def test_when_they_end() -> None:
    """Over midnight, over a change of the clocks, and for adjoining intervals."""
    hours = QuietHours(["22:00-06:00", "06:00-06:45"], TORONTO)
    for utc, end in (
        ("2026-07-15T03:10", "2026-07-15T06:45-04:00"),
        ("2026-03-08T04:00", "2026-03-08T06:45-04:00"),
        ("2026-11-01T04:00", "2026-11-01T06:45-05:00"),
    ):
        assert hours.end_after(ns(utc)) == datetime.fromisoformat(end)


def test_the_share_of_steps_in_which_the_pump_may_run() -> None:
    """From 21:30 on, steps of 15 min, 1 h, 7 h, 6 h and two days with 16 h each."""
    hours = QuietHours(["22:00-06:00"], TORONTO)
    ends = np.cumsum([0.0, 0.25, 1.0, 7.0, 6.0, 48.0]) * 3600
    shares = hours.pumping_shares(ns("2026-07-16T01:30"), ends)
    # 06:00 is 8.5 h later, 0.25 h after the third step's end.
    assert shares == pytest.approx([1.0, 0.25, 0.0, 5.75 / 6, 32 / 48], abs=1e-9)
    assert shares[2] == 0.0
    # The night of the change in spring is an hour shorter.
    (night,) = hours.pumping_shares(ns("2026-03-08T03:00"), np.array([0.0, 8.0]) * 3600)
    assert night == pytest.approx(1 / 8, abs=1e-9)


# --- in a site file -------------------------------------------------------------------------------


def written(directory: Path, *lines: str) -> Path:
    path = directory / "mine.yaml"
    path.write_text("\n".join([f"extends: {CONFIG / 'site.yaml'}", *lines]) + "\n")
    return path


def test_of_a_site(tmp_path: Path) -> None:
    file = written(
        tmp_path, 'quiet_hours: ["22:00-06:00", "12:00-13:30"]', "time_zone: America/Toronto"
    )
    site = read_site(file)
    assert site.quiet is not None
    assert site.quiet.quiet_at(ns("2026-07-15T02:00"))
    assert read_site(written(tmp_path, "quiet_hours: []", "time_zone: EST")).quiet is None
    assert read_site(CONFIG / "site.yaml").quiet is None


@pytest.mark.parametrize(("zone", "utc_offset"), [
    ("America/Toronto", -5), ("Etc/GMT+5", -5), ("EST", -5), ("Australia/Sydney", 10),
    ("Asia/Kolkata", 5.5), ("Asia/Kathmandu", 5.75), ("America/St_Johns", -3.5),
    # By law winter time is the exception in Ireland, as Ramadan's is in Morocco.
    ("Europe/Dublin", 0), ("Africa/Casablanca", 1), ("Australia/Lord_Howe", 10.5),
])
def test_a_zone_of_the_sites_standard_time(tmp_path: Path, zone: str, utc_offset: float) -> None:
    site = read_site(written(tmp_path, f"time_zone: {zone}", f"utc_offset: {utc_offset}"))
    assert site.zone == ZoneInfo(zone) and standard_offset(zone) == utc_offset
    wrong = written(tmp_path, f"time_zone: {zone}", f"utc_offset: {utc_offset + 1.25}")
    with pytest.raises(ConfigurationError, match="standard UTC offset"):
        read_site(wrong)
