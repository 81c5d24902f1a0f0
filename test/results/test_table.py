"""The table of rain events, and the columns of parameters."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import polars

from greenroof_ros.physics.storm_water import Event
from greenroof_ros.results.table import (
    EVENTS,
    event_rows,
    format_events,
)

START = datetime.fromisoformat("2021-07-07T02:00-05:00")
EVENT = Event(
    start_h=23.25, hours=1 / 3, rain_mm=6.1, max_rain_5min_mm_h=48.0, max_rain_60min_mm_h=6.1,
    discharge_m3=0.3, wet_discharge_m3=0.1, peak_l_s=1e-9, peak_mm_h=36.0, volume_reduction=-2.5,
    peak_reduction=0.25, peak_delay_min=None, complete=False,
)
ROWS = event_rows(START, [EVENT, EVENT._replace(start_h=100.0, peak_delay_min=5.0, complete=True)])


def test_events_in_a_file(tmp_path: Path) -> None:
    """To the bit, as polars reads them; 23.25 h after 02:00 is 01:15 of the next day."""
    assert ROWS[0]["start"] == "2021-07-08T01:15:00-05:00"
    (tmp_path / EVENTS).write_text(format_events(ROWS))
    frame = polars.read_csv(tmp_path / EVENTS)
    assert frame.columns == ["start", *Event._fields]
    assert frame["complete"].to_list() == [False, True]
    assert frame["peak_delay_min"].to_list() == [None, 5.0]
    assert frame.drop("start").rows()[0] == tuple(EVENT)
