"""Hydrographs for EPA's SWMM: time series of inflow, and an example network that receives them.

SWMM reads a time series from a file with a date, a time and a value on every line, and interpolates
between them (Rossman 2015, SWMM User's Manual Version 5.1, EPA-600/R-14/413b, Appendix D,
[TIMESERIES]). The mean of an interval is written at the interval's midpoint, which preserves the
volume of the interpolated flow.
"""

from __future__ import annotations

import re
from datetime import datetime, timedelta

import numpy as np

from greenroof_ros.analysis.district.buildings import Values
from greenroof_ros.base.files import shared_directory

NETWORK = "combined_sewer.inp"
"""name of the example network"""
_DATE, _TIME = "%m/%d/%Y", "%H:%M:%S"


def format_series(start: datetime, seconds: float, volumes: Values, about: str) -> str:
    """Return the text of a time series (m3/s) for a network with FLOW_UNITS CMS.

    Lines that interpolation makes redundant are left out.

    Args:
        start: time at which the first interval begins; SWMM's clock has the same offset from UTC.
        seconds: duration of an interval (s).
        volumes: volume in each interval (m3), shape (intervals,).
        about: comment for the first line.
    """
    flows = np.concatenate((volumes[:1], volumes, volumes[-1:])) / seconds
    middles = seconds * (np.arange(len(volumes)) + 0.5)
    times = np.concatenate(([0.0], middles, [seconds * len(volumes)]))
    changes = np.diff(flows) != 0
    needed = np.concatenate(([True], changes[:-1] | changes[1:], [True]))
    lines = [f";{about}", f";{_DATE.replace('%', '')} {_TIME.replace('%', '')} m3/s"]
    for time, flow in zip(times[needed].tolist(), flows[needed].tolist(), strict=True):
        moment = start + timedelta(seconds=time)
        lines.append(f"{moment.strftime(f'{_DATE} {_TIME}')} {flow:.9g}")
    return "\n".join([*lines, ""])


def format_network(start: datetime, hours: float, series: str) -> str:
    """Return the example network for a period and a time series.

    Args:
        start: time at which the period begins.
        hours: length of the period (h).
        series: name of the time series file.
    """
    end = start + timedelta(hours=hours)
    text = (shared_directory() / "config" / "swmm" / NETWORK).read_text(encoding="utf-8")
    for key, value in {
        "START_DATE": start.strftime(_DATE), "START_TIME": start.strftime(_TIME),
        "REPORT_START_DATE": start.strftime(_DATE), "REPORT_START_TIME": start.strftime(_TIME),
        "END_DATE": end.strftime(_DATE), "END_TIME": end.strftime(_TIME),
    }.items():
        text = re.sub(rf"^{key}\s+\S+", f"{key:<20} {value}", text, flags=re.MULTILINE)
    return re.sub(r'FILE ".*"', lambda _: f'FILE "{series}"', text)
