"""Compare a district with EPA's SWMM 5: the same roofs and cisterns, and the time that each takes.

``python tools/district_beside_swmm.py --weather DIR`` draws the buildings of the example district
and simulates them with this package and with SWMM. In SWMM, green roofs are low-impact-development
units (soil and drainage mat), ordinary roofs are impervious areas, and cisterns are storage units
with outlets according to Eq. (2). SWMM cannot pump a cistern's water onto a roof, so nothing is
irrigated, and there is no mains water. The command prints both times and the volumes that reach the
sewer.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import paths
from swmm.toolkit import solver
from swmm_run import run_swmm

from greenroof_ros.analysis.district.district_file import ORIFICE
from greenroof_ros.analysis.district.parts import SITE_FILE, make_sites, simulate_part, with_outlet
from greenroof_ros.analysis.district.run import DistrictRun, read_run
from greenroof_ros.analysis.district.totals import Flow
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.site.site import Site

EXAMPLE = paths.CHECKOUT / "config" / "districts" / "example.yaml"
_NO_PUMP = "level: {values: [0.0]}"


def read(buildings: int, hours: float, weather: Path, directory: Path) -> DistrictRun:
    """Return the example district without irrigation, with monthly evapotranspiration."""
    text = EXAMPLE.read_text(encoding="utf-8")
    for old, new in (
        ("buildings: 1000 ", f"buildings: {buildings} "),
        ("draw:\n", f"draw:\n  {_NO_PUMP}\n"),
        ("evapotranspiration: fao56", "evapotranspiration: monthly"),
        ("hours: 4416", f"hours: {hours}"),
        ("outlets: [none, orifice, drain, plan]", "outlets: [orifice]"),
        ("adoption: [0.1, 0.25, 0.5, 1.0]", "adoption: [1.0]"),
        ("site: house.yaml", f"site: {EXAMPLE.parent / 'house.yaml'}"),
    ):
        assert old in text, old
        text = text.replace(old, new)
    file = directory / "district.yaml"
    file.write_text(text, encoding="utf-8")
    return read_run(file, [weather])


def simulate_here(run: DistrictRun, outlet: str, directory: Path) -> float:
    """Simulate with this package, and return the discharge of all buildings to the sewer (m3)."""
    totals = run.make_totals()
    for part in run.parts():
        only = replace(part, outlets=(outlet,))
        totals.add(part.places, simulate_part(directory, only))
    return float(totals.discharge(Flow(outlet, 1.0)).sum())


def format_model(run: DistrictRun, sites: Sequence[Site], states: Sequence[float]) -> str:
    """Return SWMM's input file for buildings with an orifice.

    Args:
        run: the district.
        sites: sites of its buildings.
        states: initial volumes in the cisterns (m3).
    """
    start = run.runs[0].start.replace(tzinfo=None)
    hours = run.runs[0].steps * run.site.tau / 3600
    end = start + timedelta(hours=hours)
    monthly = run.site.monthly_evapotranspiration or ()
    evaporated = " ".join(f"{value * run.site.crop_coefficient:g}" for value in monthly)
    depths = run.make_totals().rain[0]
    rain = 1000 * depths.reshape(-1, round(len(depths) / hours)).sum(axis=1)
    sections: dict[str, list[str]] = {name: [] for name in (
        "SUBCATCHMENTS", "SUBAREAS", "INFILTRATION", "LID_CONTROLS", "LID_USAGE", "OUTFALLS",
        "STORAGE", "OUTLETS",
    )}
    kinds: dict[float, str] = {}
    for number, (site, x1) in enumerate(zip(sites, states, strict=True)):
        capacity = site.field_capacity or 0.0
        if site.z_soil not in kinds:
            kind = kinds[site.z_soil] = f"GREEN{len(kinds)}"
            # Conductivity 36 mm/h [assumed]; its slope is that of loam in SWMM's manual.
            mat = 1000 * (site.drainage_storage or 0.0) / 0.55
            sections["LID_CONTROLS"] += [
                f"{kind} GR", f"{kind} SURFACE 5 0 0.1 1 5",
                f"{kind} SOIL {1000 * site.z_soil} {capacity + 0.1} {capacity} "
                f"{site.wilting_point} 36 30 60",
                f"{kind} DRAINMAT {mat} 0.55 0.1",
            ]
        begins = (site.roof_level(site.initial_roof or 0.0) / site.z_soil) / (capacity + 0.1)
        bed, roof = f"B{number}", f"R{number}"
        sections["SUBCATCHMENTS"] += [
            f"{bed} GAUGE SEWER{number} {site.a2 / 1e4} 100 {site.a2**0.5} 2 0",
            f"{roof} GAUGE CISTERN{number} {site.effective_catchment / 1e4} 100 "
            f"{site.effective_catchment**0.5} 2 0",
        ]
        for name in (bed, roof):
            sections["SUBAREAS"].append(f"{name} 0.012 0.1 0 0 100 OUTLET")
            sections["INFILTRATION"].append(f"{name} 3 0.5 4 7 0")
        sections["LID_USAGE"].append(
            f"{bed} {kinds[site.z_soil]} 1 {site.a2} {site.a2**0.5} {100 * begins} 0 0"
        )
        sections["STORAGE"].append(
            f"CISTERN{number} 0 {4 * site.z_o} {site.cistern_level(x1)} FUNCTIONAL 0 0 {site.a1} "
            "0 0"
        )
        sections["OUTFALLS"] += [
            f"{name}{number} -10 FREE NO" for name in ("SEWER", "UPPER", "LOW")
        ]
        sections["OUTLETS"] += [
            f"{name}{number}_ CISTERN{number} {name}{number} {level} FUNCTIONAL/DEPTH {c} 0.5 NO"
            for name, level, c in (
                ("UPPER", site.z_o, site.c_out), ("LOW", site.low_outlet_level, site.c_low),
            )
        ]
    text = "\n".join(f"[{name}]\n" + "\n".join(lines) for name, lines in sections.items())
    series = "\n".join(f"RAIN {hour}:00 {value:.6g}" for hour, value in enumerate(rain))
    return f"""[OPTIONS]
FLOW_UNITS CMS
INFILTRATION HORTON
FLOW_ROUTING DYNWAVE
LINK_OFFSETS DEPTH
START_DATE {start:%m/%d/%Y}
START_TIME {start:%H:%M:%S}
END_DATE {end:%m/%d/%Y}
END_TIME {end:%H:%M:%S}
WET_STEP 00:01:00
DRY_STEP 00:01:00
REPORT_STEP 01:00:00
ROUTING_STEP 60
VARIABLE_STEP 0
[EVAPORATION]
MONTHLY {evaporated}
DRY_ONLY NO
[RAINGAGES]
GAUGE VOLUME 1:00 1.0 TIMESERIES RAIN
{text}
[TIMESERIES]
{series}
[REPORT]
INPUT NO
"""


def read_discharge() -> float:
    """Return the discharge of all buildings to the sewer in SWMM (m3)."""
    totals = solver.system_get_routing_totals()
    return float(totals.outflow + totals.flooding)


def main() -> None:
    """Run both models and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--weather", type=Path, required=True, help="directory of Toronto's files, YYYY_M.csv"
    )
    parser.add_argument("--buildings", type=int, default=1000)
    parser.add_argument("--hours", type=float, default=4416)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        directory = Path(scratch)
        run = read(
            arguments.buildings, arguments.hours, arguments.weather.resolve(), directory
        )
        write_inputs(run.files, directory)
        sites = [*make_sites(directory / SITE_FILE, run.buildings)]
        variants = [
            with_outlet(run.district, ORIFICE, sites, run.buildings, place)
            for place in range(len(sites))
        ]
        model = directory / "district.inp"
        model.write_text(format_model(
            run, [each.site for each in variants], [each.state[0] for each in variants]
        ), encoding="utf-8")
        begun = time.perf_counter(), time.process_time()
        ours = simulate_here(run, ORIFICE, directory)
        between = time.perf_counter(), time.process_time()
        theirs, errors = run_swmm(model, read_discharge)
        end = time.perf_counter(), time.process_time()
    here, there = np.subtract(between, begun), np.subtract(end, between)
    print(f"{arguments.buildings} roofs and cisterns with an orifice, {arguments.hours:g} h")
    print(f"greenroof: {here[0]:.1f} s ({here[1]:.1f} s of processor time), {ours:.0f} m3")
    print(
        f"SWMM 5:    {there[0]:.1f} s ({there[1]:.1f} s of processor time), {theirs:.0f} m3, "
        f"continuity {errors.runoff:.2f} % (runoff), {errors.routing:.2f} % (routing)"
    )
    print(f"{there[1] / here[1]:.1f} times the processor time; {theirs / ours - 1:+.1%} volume")


if __name__ == "__main__":
    sys.exit(main())
