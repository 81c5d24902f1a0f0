"""Routing of a district's flows by EPA's SWMM, through a network scaled to the district.

SWMM reads a time series from a file with a date, a time and a value on every line, and interpolates
between them (Rossman 2015, SWMM User's Manual Version 5.1, EPA-600/R-14/413b, Appendix D,
[TIMESERIES]). The mean of an interval is written at the interval's midpoint, which preserves the
volume of the interpolated flow.

The network is a combined sewer with an overflow: a trunk of pipes receives each adoption group at a
node of its own, a throttle leads to the treatment plant, and a weir to the river. The template
``config/swmm/combined_sewer.inp`` contains its sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import polars as pl

from greenroof_ros.analysis.district.buildings import Scene
from greenroof_ros.base.files import shared_directory
from greenroof_ros.simulation.run import Values

TEMPLATE = shared_directory() / "config/swmm/combined_sewer.inp"


def format_series(start: datetime, durations: Values, volumes: Values) -> str:
    """Return the text of a time series (m3/s) for a network with FLOW_UNITS CMS.

    Lines that interpolation makes redundant are left out.

    Args:
        start: time at which the first interval begins; SWMM's clock has the same offset from UTC.
        durations: duration of each interval (s), shape (intervals,).
        volumes: volume in each interval (m3), shape (intervals,).
    """
    flows, ends = volumes / durations, np.cumsum(durations)
    flows = np.concatenate((flows[:1], flows, flows[-1:]))
    times = np.concatenate(([0.0], ends - durations / 2, ends[-1:]))
    changes = np.diff(flows) != 0
    needed = np.concatenate(([True], changes[:-1] | changes[1:], [True]))
    return pl.DataFrame({
        "time": np.datetime64(start, "ms") + (1000 * times[needed]).astype("timedelta64[ms]"),
        "flow": flows[needed],
    }).write_csv(
        include_header=False, separator=" ", quote_style="never",
        datetime_format="%m/%d/%Y %H:%M:%S",
    )


def format_network(**values: Any) -> str:
    """Return the network for a period, with a node for each time series.

    Args:
        values: ``start`` and ``end`` of the period; ``series``, the names of the files of the time
            series, from the near end of the trunk; the connected ``area`` (m2); and the
            ``capacity``, the flow that the throttle takes when the water is level with the weir
            (mm/h over the connected area).
    """
    template = jinja2.Template(TEMPLATE.read_text(encoding="utf-8"), trim_blocks=True)
    return str(template.render(values))


def route_scene(directory: Path, scene: Scene, rows: Sequence[dict[str, Any]]) -> None:
    """Route the district as it is and each outlet at the highest adoption, and complete the rows.

    The rows receive the water that flows over the weir into the river, and the highest flow at the
    end of the trunk. Without swmm-toolkit, only the files for SWMM are written.

    Args:
        directory: directory for the networks, their series, and SWMM's reports.
        scene: flows of the buildings.
        rows: results of the flows of the scene.
    """
    directory.mkdir(parents=True, exist_ok=True)
    end = scene.start + timedelta(seconds=float(scene.durations.sum()))
    for flow, row in zip(scene.flows, rows, strict=True):
        if flow.adoption not in (0, scene.flows[-1].adoption):
            continue
        series, name = scene.group_discharges(flow), f"{flow.outlet}_{100 * flow.adoption:03g}"
        files = [f"{name}_{number}.dat" for number in range(1, len(series) + 1)]
        for file, volumes in zip(files, series, strict=True):
            (directory / file).write_text(format_series(scene.start, scene.durations, volumes))
        model = directory / f"{name}.inp"
        model.write_text(format_network(
            start=scene.start, end=end, series=files, area=scene.areas.sum(),
            capacity=scene.district.sewer_capacity,
        ))
        row |= run_network(model)


def run_network(model: Path) -> dict[str, float]:
    """Run a network: return the overflow into the river (m3) and the trunk's peak flow (L/s).

    There are no values if swmm-toolkit is not installed.
    """
    try:
        from swmm.toolkit import shared_enum, solver  # type: ignore[import-untyped]
    except ImportError:
        return {}
    solver.swmm_open(*(str(model.with_suffix(suffix)) for suffix in (".inp", ".rpt", ".out")))
    try:
        solver.swmm_start(0)
        river = solver.project_get_index(shared_enum.ObjectType.NODE, "RIVER")
        trunk = solver.project_get_index(shared_enum.ObjectType.LINK, "PIPE1")
        peak = 0.0
        while solver.swmm_step():
            peak = max(peak, solver.link_get_result(trunk, shared_enum.LinkResult.FLOW))
        overflow = float(solver.node_get_total_inflow(river))
        solver.swmm_end()
    finally:
        solver.swmm_close()
        model.with_suffix(".out").unlink(missing_ok=True)
    return {"routed_overflow_m3": overflow, "routed_peak_l_s": 1000 * peak}
