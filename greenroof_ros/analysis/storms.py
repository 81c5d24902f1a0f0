"""Design storms on a house: peak and volume for each return period, valve and kind of roof."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenroof_ros.analysis.tables import Column, Table, format_number, format_share
from greenroof_ros.base.errors import ConfigurationError, describe_choices, require_extra
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import CLOSED, DRAIN, PLAN, POLICIES
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.storm_water import connected_area
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.season import Case, simulate_season
from greenroof_ros.site.file import check_site
from greenroof_ros.site.site import WITHOUT_VALVE, Site
from greenroof_ros.weather.depths import read_depths
from greenroof_ros.weather.storm import EULER, make_storm

if TYPE_CHECKING:
    import polars

    from greenroof_ros.analysis.figures import Figure

PAGE, TABLE = "storms.html", "storms.csv"
STATES = WET, DRY = "wet", "dry"
NO_ROOF, ALONE = "no green roof", "green roof without irrigation"
BEFORE_H, AFTER_H = 48, 72
"""hours without rain before a storm, for which plan looks ahead, and after it"""
_START = np.datetime64("2001-07-01T00:00", "m")
_TAU, _RUN_ON_H, _FACTOR = 60.0, 24, Range(0.1, 10.0)
_COLUMNS = {
    "return_period_years": Column("return period", "years", format_number),
    "case": Column("case", ""), "rain_mm": Column("rain", "mm", format_number),
    "peak_l_s": Column("peak", "L/s", format_number),
    "peak_reduction": Column("lower peak", "%", format_share),
    "volume_m3": Column("volume", "m³", format_number),
    "volume_reduction": Column("lower volume", "%", format_share),
    "discharge_m3": Column("in all weather", "m³", format_number),
}


def design_storm(
    depths: str | os.PathLike[str], return_period: float, *, kind: str = EULER,
    duration: int = 120, step: int = 5, peak: float | None = None, rain_factor: float = 1.0,
) -> polars.DataFrame:
    """Return a design storm as weather, which ``gr.simulate`` and ``write_csv`` take.

    The storm begins on 3 July 2001 at 00:00, after 48 hours without rain, and 72 hours without rain
    follow it. Nothing evaporates.

    Args:
        depths: file of depths by duration and return period, see :mod:`.weather.depths`.
        return_period: return period (years).
        kind: ``"block"``, ``"euler"`` (type II) or ``"chicago"``, see :mod:`.weather.storm`.
        duration: duration of the storm (min).
        step: duration of a step (min), which divides an hour.
        peak: position of the peak as a share of the duration; by default, 0.3 for ``"euler"`` and
            0.375 for ``"chicago"``.
        rain_factor: factor by which all rain is multiplied, such as 1.2 for a future climate.

    Raises:
        ConfigurationError: if an input or the file is invalid, or polars is not installed.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.design_storm("depths.yaml", 10, duration=60)  # doctest: +SKIP
    """
    factor = _FACTOR.read(rain_factor, key="rain_factor")
    rain = factor * make_storm(
        read_depths(Path(depths)), return_period, kind, duration, step, peak
    )
    rates = np.pad(rain * 60 / step, [
        (BEFORE_H * 60 // step, (-duration % 60 + 60 * AFTER_H) // step)
    ])
    return make_frame({
        "time": (_START + step * np.arange(len(rates))).astype(str),
        "precipitation [mm/h]": rates,
        "assumed evapotranspiration [mm/day]": np.zeros(len(rates)),
    })


@dataclass(frozen=True, eq=False, repr=False)
class Storms:
    """The discharge of a house in design storms.

    Attributes:
        table: a row for each return period and case. The peak is the highest five-minute mean, and
            the volume the discharge, from the first rain to the end of wet weather. The reductions
            are relative to the same area without a green roof and a cistern. ``discharge_m3`` is
            the discharge of the whole run, with what a valve releases before the storm.
        notes: what the results rest on.
    """

    table: polars.DataFrame
    notes: Sequence[str]

    @property
    def shown(self) -> Table:
        """The table as people read it."""
        return Table("Discharge to the sewer", [*_COLUMNS.values()], self.table.rows())

    def plot(self) -> Any:
        """Return a chart of the peaks and volumes."""
        return self._draw().chart()

    def _draw(self) -> Figure:
        with require_extra("study"):
            import altair as alt

            from greenroof_ros.analysis.figures import COLOURS, Figure, Panel
        cases = self.table["case"].unique(maintain_order=True).to_list()
        base = alt.Chart(alt.NamedData("storms")).mark_bar().encode(
            x=alt.X("return_period_years:O", title="return period (years)"),
            xOffset=alt.XOffset("case:N", sort=cases),
            color=alt.Color("case:N", title=None, scale=alt.Scale(domain=cases, range=[*COLOURS])),
        )
        panels = [
            Panel(base.encode(y=alt.Y(f"{name}:Q", title=None)), _COLUMNS[name].heading)
            for name in ("peak_l_s", "volume_m3")
        ]
        return Figure("storms", "Design storms", "", (*panels,), 2, {"storms": self.table.to_dicts()})

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page, the table and the picture to a folder, and return the page."""
        with require_extra("study"):
            from greenroof_ros.analysis.page import Section, claim_output, make_page, write_output
        claim_output(Path(directory), PAGE, [TABLE])
        figure, answer = self._draw(), self.notes[0]
        html = make_page("Design storms", answer, [
            Section("Peaks and volumes", [self.shown, figure]),
            Section("What it rests on", [self.notes[1:]]),
        ])
        return write_output(Path(directory), PAGE, html, [figure], {TABLE: self.table.write_csv()})


def storms(
    site: Any, depths: str | os.PathLike[str], *, return_periods: Sequence[float] = (2, 10, 100),
    outlets: Sequence[str] | None = None, state: str = WET, filled: float = 1.0, **storm: Any,
) -> Storms:
    """Compute peak and volume of design storms, like ``greenroof storm --run``.

    The house is simulated in ticks of a minute, from 48 hours before the storm, in which a valve
    can make room, to a day after it. ``plan`` has a perfect forecast. The irrigation is on/off
    control. Nothing evaporates.

    Args:
        site: site file, or a site from ``gr.read_site``.
        depths: file of depths by duration and return period, see :mod:`.weather.depths`.
        return_periods: return periods (years).
        outlets: policies of the outlet valve; by default ``("closed", "drain", "plan")``, and none
            at a site without a valve.
        state: roof and drainage layer 48 hours before the storm. ``"wet"``: at field capacity;
            ``"dry"``: a roof with irrigation at its target, and one without at the wilting point.
        filled: share of the cistern that is full 48 hours before the storm.
        storm: ``kind``, ``duration``, ``step``, ``peak`` and ``rain_factor`` of
            :func:`design_storm`.

    Returns:
        The results: ``.table``, ``.plot()`` and ``.save(directory)``, which writes a page.

    Raises:
        ConfigurationError: if an input is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.storms("config/site_valve.yaml", "depths.yaml").table  # doctest: +SKIP
    """
    control = find_controller("onoff")
    house = replace(make_inputs(control, {"site": site}).read_site(), tau=_TAU, M=1)
    if state not in STATES:
        raise ConfigurationError(describe_choices(STATES, state), key="state", value=state)
    if outlets is None:
        outlets = (CLOSED, DRAIN, PLAN) if house.low_outlet_valve else ()
    full = Range(0.0, 1.0).read(filled, key="filled") * house.a1 * house.z_o
    alone = check_site(replace(
        house, irrigation="none", a_in=1e-9, drainage_to_cistern=0.0, **WITHOUT_VALVE,
        **dict.fromkeys(("low_outlet_level", "low_outlet_radius", "mains_level", "mains_flow")),
    ))
    wet, dry = (house.z_cap, house.z_cap), (house.x2_star, house.wilting_volume)
    roof, bare = wet if state == WET else dry
    cases = {ALONE: (alone, {}, 0.0, bare)} | (
        {f"valve: {each}": (house, {"outlet": each}, full, roof) for each in outlets}
        or {"green roof and cistern": (house, {}, full, roof)}
    )
    rows = []
    for period in return_periods:
        weather = design_storm(depths, period, **storm)
        duration, step = storm.get("duration", 120), storm.get("step", 5)
        rain = np.repeat(weather["precipitation [mm/h]"].to_numpy(), step) / 60_000
        hours = BEFORE_H + math.ceil(duration / 60) + _RUN_ON_H
        run = make_inputs(control, {
            "site": house, "weather": weather, "start": str(_START), "hours": hours,
            "cistern": full, "roof": roof,
        }).build()
        _, made = simulate_season([
            Case(one, control.complete_parameters(one, given), run, x1, x2, group=n)
            for n, (one, given, x1, x2) in enumerate(cases.values())
        ])
        rain = rain[: 60 * hours]
        flows = {NO_ROOF: connected_area(house) * rain} | dict(zip(cases, made[:, 0], strict=True))
        flows[ALONE] = flows[ALONE] + house.effective_catchment * rain
        first = 60 * BEFORE_H
        during = slice(first, first + duration + round(60 * house.wet_after))
        volumes = {case: flow[during].sum() for case, flow in flows.items()}
        peaks = {
            case: np.convolve(flow[during], np.ones(5), "valid").max() / 0.3
            for case, flow in flows.items()
        }
        rows += [{
            "return_period_years": period, "case": case, "rain_mm": 1000 * rain.sum(),
            "peak_l_s": peaks[case], "peak_reduction": 1 - peaks[case] / peaks[NO_ROOF],
            "volume_m3": volumes[case], "volume_reduction": 1 - volumes[case] / volumes[NO_ROOF],
            "discharge_m3": flows[case].sum(),
        } for case in flows]
    return Storms(make_frame(rows), [read_depths(Path(depths)).note])
