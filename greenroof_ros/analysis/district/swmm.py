"""Routing of a district's flows by EPA's SWMM, through a network scaled to the district.

SWMM reads a time series from a file with a date, a time and a value on every line, and interpolates
between them (Rossman 2015, SWMM User's Manual Version 5.1, EPA-600/R-14/413b, Appendix D,
[TIMESERIES]). The mean of an interval is written at the interval's midpoint, which preserves the
volume of the interpolated flow.

The network is a combined sewer with an overflow: a trunk of pipes receives each adoption group at a
node of its own, a throttle leads to the treatment plant, and a weir to the river. Its sizes are
those of ``config/swmm/combined_sewer.inp`` for 24 ha, scaled to the area and the capacity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from greenroof_ros.analysis.district.buildings import Values
from greenroof_ros.analysis.district.scene import Scene
from greenroof_ros.base.files import replace_text, shared_directory
from greenroof_ros.physics.storm_water import HOUR_S

_DATE, _TIME = "%m/%d/%Y", "%H:%M:%S"
# Area (m2), and diameter and length of the trunk (m), for which the network was drawn [assumed];
# slope of the trunk; and capacity of a sewer that is not stated (mm/h).
_AREA, _DIAMETER, _LENGTH, _SLOPE, _CAPACITY = 240_000.0, 1.8, 500.0, 0.005, 5.0
_CREST = 1.0 / 1.8
"""height of the weir above the bottom, as a share of the trunk's diameter"""


def format_series(start: datetime, durations: Values, volumes: Values, about: str) -> str:
    """Return the text of a time series (m3/s) for a network with FLOW_UNITS CMS.

    Lines that interpolation makes redundant are left out.

    Args:
        start: time at which the first interval begins; SWMM's clock has the same offset from UTC.
        durations: duration of each interval (s), shape (intervals,).
        volumes: volume in each interval (m3), shape (intervals,).
        about: comment for the first line.
    """
    flows = volumes / durations
    flows = np.concatenate((flows[:1], flows, flows[-1:]))
    ends = np.cumsum(durations)
    times = np.concatenate(([0.0], ends - durations / 2, ends[-1:]))
    changes = np.diff(flows) != 0
    needed = np.concatenate(([True], changes[:-1] | changes[1:], [True]))
    lines = [f";{about}", f";{_DATE.replace('%', '')} {_TIME.replace('%', '')} m3/s"]
    for time, flow in zip(times[needed].tolist(), flows[needed].tolist(), strict=True):
        moment = start + timedelta(seconds=time)
        lines.append(f"{moment.strftime(f'{_DATE} {_TIME}')} {flow:.9g}")
    return "\n".join([*lines, ""])


def format_network(
    start: datetime, seconds: float, series: Sequence[str], area: float, capacity: float
) -> str:
    """Return the network for a period, with a node for each time series.

    Args:
        start: time at which the period begins.
        seconds: length of the period (s).
        series: names of the files of the time series, from the far end of the trunk.
        area: connected area (m2).
        capacity: flow that the throttle takes when the water is level with the weir (mm/h over the
            connected area).
    """
    length = _LENGTH * math.sqrt(area / _AREA) / len(series)
    diameter = _DIAMETER * (area / _AREA) ** (3 / 8)  # by Manning, the full flow grows as the area
    flow, crest, throttle = capacity / 1000 / HOUR_S * area, _CREST * diameter, 0.0
    for _ in range(50):  # the head above the middle of the throttle depends on its diameter
        head = max(crest - throttle / 2, crest / 2)
        throttle = math.sqrt(4 * flow / (0.61 * math.pi * math.sqrt(2 * 9.81 * head)))
    nodes = [f"GROUP{number}" for number in range(1, len(series) + 1)]
    end, ends = start + timedelta(seconds=seconds), [*nodes[1:], "REGULATOR"]
    text = (shared_directory() / "config/swmm/combined_sewer.inp").read_text(encoding="utf-8")
    return text.format(
        date=start.strftime(_DATE), time=start.strftime(_TIME), end_date=end.strftime(_DATE),
        end_time=end.strftime(_TIME), crest=crest, depth=max(5.0, 3 * diameter),
        throttle=throttle, weir=6 * area / _AREA, diameter=diameter,
        junctions="\n".join(
            f"{node} {_SLOPE * length * (len(nodes) - n):.4f} {max(4.0, 2 * diameter):.3f}"
            for n, node in enumerate(nodes)
        ),
        conduits="\n".join(
            f"TO_{to} {node} {to} {length:.2f} 0.013 0 0"
            for node, to in zip(nodes, ends, strict=True)
        ),
        sections="\n".join(f"TO_{to} CIRCULAR {diameter:.4f} 0 0 0" for to in ends),
        sewages="\n".join(
            f"{node} FLOW {0.0052 * area / _AREA / len(nodes):.6f}" for node in nodes
        ),
        inflows="\n".join(f"{node} FLOW {node} FLOW 1.0 1.0" for node in nodes),
        series="\n".join(
            f'{node} FILE "{file}"' for node, file in zip(nodes, series, strict=True)
        ),
    )


def route_scene(
    directory: Path, scene: Scene, start: datetime, rows: Sequence[dict[str, Any]],
    capacity: float | None,
) -> None:
    """Route the district as it is and each outlet at the highest adoption, and complete the rows.

    The rows receive the water that flows over the weir into the river, and the highest flow at the
    end of the trunk. Without swmm-toolkit, only the files for SWMM are written.

    Args:
        directory: directory for the networks, their series, and SWMM's reports.
        scene: flows of the buildings.
        start: time at which the scene begins.
        rows: results of the flows of the scene.
        capacity: capacity of the sewer (mm/h over the connected area).
    """
    directory.mkdir(parents=True, exist_ok=True)
    start, area = start.replace(tzinfo=None), float(scene.areas.sum())
    highest = scene.flows[-1].adoption
    for flow, row in zip(scene.flows, rows, strict=True):
        if flow.adoption not in (0, highest):
            continue
        files = []
        for number, volumes in enumerate(scene.group_discharges(flow), 1):
            files.append(f"{flow.name}_{number}.dat")
            text = format_series(start, scene.durations, volumes, f"{flow.name}, group {number}")
            replace_text(directory / files[-1], text)
        model = directory / f"{flow.name}.inp"
        seconds = float(scene.durations.sum())
        replace_text(model, format_network(start, seconds, files, area, capacity or _CAPACITY))
        row |= run_network(model)


def run_network(model: Path) -> dict[str, float | None]:
    """Run a network: return the overflow into the river (m3) and the trunk's peak flow (L/s).

    The values are None if swmm-toolkit is not installed.
    """
    try:
        from swmm.toolkit import solver  # type: ignore[import-untyped]
        from swmm.toolkit.shared_enum import (  # type: ignore[import-untyped]
            LinkResult,
            ObjectType,
        )
    except ImportError:
        return {"routed_overflow_m3": None, "routed_peak_l_s": None}
    solver.swmm_open(*(str(model.with_suffix(suffix)) for suffix in (".inp", ".rpt", ".out")))
    try:
        solver.swmm_start(0)
        river, trunk = (
            solver.project_get_index(kind, name)
            for kind, name in ((ObjectType.NODE, "RIVER"), (ObjectType.LINK, "TO_REGULATOR"))
        )
        peak = 0.0
        while solver.swmm_step():
            peak = max(peak, solver.link_get_result(trunk, LinkResult.FLOW))
        overflow = float(solver.node_get_total_inflow(river))
        solver.swmm_end()
    finally:
        solver.swmm_close()
        model.with_suffix(".out").unlink(missing_ok=True)
    return {"routed_overflow_m3": overflow, "routed_peak_l_s": 1000 * peak}
