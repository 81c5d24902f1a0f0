"""Design storms on a house: peak and volume for each return period, valve and kind of roof."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import altair as alt
import numpy as np
import polars as pl

from greenroof_ros.analysis.figures import COLOURS, Figure, Panel
from greenroof_ros.analysis.page import Section, claim_output, make_page, write_output
from greenroof_ros.analysis.references import NO_IRRIGATION, NO_ROOF, remove_cistern
from greenroof_ros.analysis.tables import Table, format_number, format_share
from greenroof_ros.base.errors import ConfigurationError, describe_choices
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import DRAIN, PLAN
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.physics.storm_water import connected_area
from greenroof_ros.simulation import loop
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.weather.design_storm import Depths, make_storm, read_depths

PAGE, TABLE = "storms.html", "storms.csv"
HEADINGS = {
    "case": "case", "return_period_years": "years", "rain_mm": "rain (mm)",
    "peak_l_s": "peak (L/s)", "peak_reduction_percent": "lower by (%)",
    "volume_m3": "volume (m³)", "volume_reduction_percent": "less by (%)",
    "discharge_m3": "in all weather (m³)",
}
BEFORE_H, AFTER_H = 48, 72
"""hours without rain before a storm, for which plan looks ahead, and after it"""
_START, _RAIN = np.datetime64("2001-07-01T00:00", "m"), "precipitation [mm/h]"
_RUN_ON_H = 24


def design_storm(
    depths: str | os.PathLike[str] | Depths, return_period: float, *, kind: str = "euler",
    duration: int = 120, step: int = 5, peak: float | None = None, rain_factor: float = 1.0,
) -> pl.DataFrame:
    """Return a design storm as weather, which ``gr.simulate`` takes.

    The storm begins on 3 July 2001 at 00:00, after 48 hours without rain, and 72 hours without rain
    follow it. Nothing evaporates.

    Args:
        depths: file of depths by duration and return period, see :mod:`.weather.design_storm`, or
            its content.
        return_period: return period (years).
        kind: ``"block"``, ``"euler"`` (type II) or ``"chicago"``, see :mod:`.weather.design_storm`.
        duration: duration of the storm (min).
        step: duration of a step (min), which divides an hour.
        peak: position of the peak as a share of the duration; by default, 0.3 for ``"euler"`` and
            0.375 for ``"chicago"``.
        rain_factor: factor by which all rain is multiplied, such as 1.2 for a future climate.

    Raises:
        ConfigurationError: if an input or the file is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> storm = gr.design_storm("depths.yaml", 10, duration=60)  # doctest: +SKIP
        >>> storm.write_csv("storm.csv")  # doctest: +SKIP
    """
    factor = Range(0.5, 3.0).read(rain_factor, key="rain_factor")
    source = depths if isinstance(depths, Depths) else read_depths(Path(depths))
    rain = make_storm(source, return_period, kind, duration, step, peak)
    dry = BEFORE_H * 60 // step, (-duration % 60 + 60 * AFTER_H) // step
    rates = np.pad(factor * rain * 60 / step, dry)
    times = (_START + step * np.arange(len(rates))).astype(str)
    return pl.DataFrame({
        "time": times, _RAIN: rates, "assumed evapotranspiration [mm/day]": 0.0 * rates,
    })


@dataclass(frozen=True, eq=False, repr=False)
class Storms:
    """The discharge of a house in design storms.

    Attributes:
        table: a row for each return period and case. The peak is the highest five-minute mean, and
            the volume the discharge, from the first rain to the end of wet weather. The reductions
            are relative to the same area without a green roof and a cistern. ``discharge_m3`` is
            the discharge of the whole run, with what a valve releases before the storm.
        title: title of the page.
        duration: duration of the storms (min).
        notes: what the results rest on.
        read: what was read.
    """

    table: pl.DataFrame
    title: str
    duration: int
    notes: Sequence[str]
    read: Sequence[str]

    @property
    def sentence(self) -> str:
        """The results of the last case in every storm, and of ``drain``, which foresees nothing."""
        told = pl.col("case").is_in([self.table["case"][-1], f"valve {DRAIN}"])
        foresight = {f"valve {PLAN}": ", which has a perfect forecast here"}
        cases = self.table.filter(told).group_by("case", maintain_order=True)
        return "The peak is lower than without the cistern and the green roof. " + " ".join(
            f"With {case}{foresight.get(str(case), '')}: " + "; ".join(
                f"a storm of {years:g} years ({rain:.0f} mm in {self.duration} min) by "
                f"{format_share(less / 100)} %, to {peak:.1f} L/s"
                for _, years, rain, peak, less, *_ in rows.rows()
            ) + "." for (case,), rows in cases
        )

    @property
    def shown(self) -> Table:
        """The table for people."""
        return Table("Discharge to the sewer", [*HEADINGS.values()], [
            [case, *(format_number(round(each, 1) + 0.0) for each in values)]
            for case, *values in self.table.rows()
        ])

    def draw(self) -> Figure:
        """Return the picture of the peaks and volumes; its ``chart()`` is for a notebook."""
        cases = self.table["case"].unique(maintain_order=True).to_list()
        base = alt.Chart(alt.NamedData("storms")).mark_bar().encode(
            x=alt.X(
                "return_period_years:O", title="return period (years)",
                axis=alt.Axis(labelAngle=0),
            ),
            xOffset=alt.XOffset("case:N", sort=cases),
            color=alt.Color("case:N", title=None, scale=alt.Scale(domain=cases, range=[*COLOURS])),
        )
        first, second = (
            Panel(base.encode(y=alt.Y(f"{name}:Q", title=None)), HEADINGS[name])
            for name in ("peak_l_s", "volume_m3")
        )
        data = {"storms": self.table.to_dicts()}
        title = "Peak and volume of the discharge to the sewer"
        return Figure("storms", title, "", (first, second), 2, data)

    def save(self, directory: str | os.PathLike[str]) -> Path:
        """Write the page, the table and the picture to a folder, and return the page.

        Raises:
            ConfigurationError: if the folder contains anything but an earlier result.
        """
        figure, folder = self.draw(), Path(directory)
        claim_output(folder, PAGE, [TABLE])
        html = make_page(self.title, self.sentence, [
            Section("Peaks and volumes", [self.shown]),
            Section("Pictures", [figure]),
            Section("What it rests on", [self.notes]),
            Section("What was read", [self.read]),
            Section("How it was made", [
                "Each storm was simulated with each case in ticks of a minute, from "
                f"{BEFORE_H} h before the storm to {_RUN_ON_H} h after it, by greenroof storm "
                f"--run. {TABLE} contains the numbers.",
            ]),
        ])
        return write_output(folder, PAGE, html, [figure], {TABLE: self.table.write_csv()})


def storms(
    site: Any, depths: str | os.PathLike[str], *, return_periods: Sequence[float] = (2, 10, 100),
    outlets: Sequence[str] = ("closed", "drain", "plan"), state: str = "wet", filled: float = 1.0,
    duration: int = 120, step: int = 5, **storm: Any,
) -> Storms:
    """Compute peak and volume of design storms, like ``greenroof storm --run``.

    The house is simulated in ticks of a minute, from 48 hours before the storm, in which a valve
    can make room, to a day after it. ``plan`` has a perfect forecast. The irrigation is on/off
    control. Nothing evaporates.

    Args:
        site: site file, or a site from ``gr.read_site``.
        depths: file of depths by duration and return period, see :mod:`.weather.design_storm`.
        return_periods: return periods (years).
        outlets: policies of the outlet valve, which are not used at a site without a valve.
        state: roof 48 hours before the storm. ``"wet"``: at field capacity; ``"dry"``: a roof with
            irrigation at its target, and one without at the wilting point.
        filled: share of the cistern that is full 48 hours before the storm.
        duration: duration of the storm (min).
        step: duration of a step (min), which divides an hour.
        storm: ``kind``, ``peak`` and ``rain_factor`` of :func:`design_storm`.

    Returns:
        The results: ``.table``, ``.draw()`` and ``.save(directory)``, which writes a page.

    Raises:
        ConfigurationError: if an input is invalid.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.storms("config/site_valve.yaml", "depths.yaml").table  # doctest: +SKIP
    """
    source, control = read_depths(Path(depths)), find_controller("onoff")
    inputs = make_inputs(control, {"site": site})
    house_file, house = inputs.site, replace(inputs.read_site(), tau=60.0, M=1)
    full, without = filled * house.a1 * house.z_o, remove_cistern(house)
    states = {"wet": (house.z_cap, house.z_cap), "dry": (house.x2_star, house.wilting_volume)}
    if state not in states:
        raise ConfigurationError(describe_choices(states, state), key="state", value=state)
    roof, dry_roof = states[state]
    cases: dict[str, dict[str, Any]] = {
        NO_IRRIGATION: {"site": without, "initial": (without.a1 * house.z_o, dry_roof)}
    }
    for each in outlets if house.low_outlet_valve else ("none",):
        given = {"outlet": each} if house.low_outlet_valve else {}
        name = f"valve {each}" if given else "no valve"
        cases[name] = {"site": house, "initial": (full, roof), **given}
    hours, rows = BEFORE_H + math.ceil(duration / 60) + _RUN_ON_H, list[tuple[Any, ...]]()
    for period in map(float, return_periods):
        weather = design_storm(source, period, duration=duration, step=step, **storm)
        flows = list[tuple[Any, ...]]()
        for case, given in cases.items():
            run = make_inputs(control, {
                "weather": weather, "start": _START, "hours": hours, **given
            }).build()
            summary, _ = loop.simulate(run)
            event = summary["events"][0]
            flows.append((
                case, period, event["rain_mm"], event["peak_l_s"], 100 * event["peak_reduction"],
                event["wet_discharge_m3"], 100 * event["volume_reduction"], summary["discharge_m3"],
            ))
        area, fallen = connected_area(house), event["rain_mm"]
        peak, volume = area * event["max_rain_5min_mm_h"] / 3600, area * fallen / 1000
        rows += [(NO_ROOF, period, fallen, peak, 0.0, volume, 0.0, volume), *flows]
    of = f" at {house_file.stem}" if isinstance(house_file, Path) else ""
    factor, position = storm.get("rain_factor", 1.0), storm.get("peak")
    if factor != 1:
        of += f", rain times {factor:g}"
    return Storms(
        pl.DataFrame(rows, [*HEADINGS], orient="row"), f"Peaks and volumes of design storms{of}",
        duration, [
            f"Each storm ({storm.get('kind', 'euler')}) lasts {duration} min, "
            f"in steps of {step} min"
            + (f", with its peak at {100 * position:g} % of this time" if position else "")
            + (f"; all rain is multiplied by {factor:g}." if factor != 1 else "."),
            f"The state {BEFORE_H} h before a storm: {state} roof, {100 * filled:g} % full "
            "cistern. Nothing evaporates, and plan has a perfect forecast.",
            f"{NO_ROOF.capitalize()}: all rain on the {house.a2:g} m² of the green roof, and "
            f"{100 * house.runoff_coefficient:g} % of that on {house.a_in:g} m² of other roofs, "
            f"reaches the sewer at once. {NO_IRRIGATION.capitalize()}: no cistern either.",
            "Peaks are means of 5 min. Peaks and volumes count from the first rain to "
            f"{house.wet_after:g} h after the last.",
        ], [source.note],
    )
