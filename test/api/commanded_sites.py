"""Sites and weather in which everything happens that limits commands: frost, quiet hours, storms.

Clocks change on 14 March 2021.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
import polars
from paper import VALVE
from places import CONFIG

import greenroof_ros as gr

FIRST = datetime(2021, 3, 12, 5, tzinfo=timezone.utc)


def weather(minutes: int = 60) -> polars.DataFrame:
    """Four days: storms, drizzle and long dry hours, and frost in every night."""
    rows = 4 * 1440 // minutes
    times = [FIRST + timedelta(minutes=minutes * row) for row in range(rows)]
    chance = np.random.default_rng(4)
    rain = chance.gamma(0.5, 6.0, rows) * (chance.random(rows) < 0.15)
    hours = np.arange(rows) * minutes // 60
    return polars.DataFrame({
        "time": [time.isoformat() for time in times], "precipitation [mm/h]": rain.round(2),
        "temperature [degC]": 5.0 - 7 * np.cos(2 * np.pi * (hours - 5) / 24),
        "my evapotranspiration [mm/day]": 1.0 + hours % 7,
    })


LIMITED: dict[str, Any] = {
    "time_zone": "America/Toronto", "quiet_hours": ["22:00-01:30", "12:00-13:00"],
    "tau": 60.0, "M": 1,
}
VALVE_SITE = gr.read_site(**VALVE, **LIMITED, valve_closed_in_frost=True)
WHOLE_SITE = replace(VALVE_SITE, valve_moves_per_hour=4.0)
FIELD_CAPACITY = gr.read_site(CONFIG / "site_neubrandenburg.yaml", **LIMITED)
IMPERFECT = {
    "roof_noise": 0.002, "roof_offset": -0.001, "noise_seed": 2, "pump_min_on": 300.0,
    "pump_min_off": 1200.0,
}
