"""A start without an offset is the wall clock of the site's zone."""

from __future__ import annotations

import pytest

import greenroof_ros as gr


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
