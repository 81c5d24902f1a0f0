"""Models to compare the fitted roof with: SWMM as its authors calibrated it, and a bucket."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from measured_roofs.roofs import STEP_S, Roof, temperatures
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from greenroof_ros.analysis.calibration.record import RoofRecord, sums

Values = NDArray[np.float64]


def swmm(roof: Roof, directory: Path, record: RoofRecord, scratch: Path) -> Values:
    """Run SWMM with the roof's own model; return runoff (mm in each step), NaN outside its run."""
    from pyswmm import Output, Simulation
    from swmm.toolkit.shared_enum import NodeAttribute

    text = (directory / f"{roof.name}.inp").read_text(encoding="utf-8")
    rain_file, station = re.search(r'FILE\s+"(obs_rain[^"]*)"\s+(\S+)', text).groups()
    temperature_file = re.search(r'FILE\s+"(obs_temp[^"]*)"', text)[1]
    area = float(re.search(r"^S1\s+\S+\s+\S+\s+(\S+)", text, re.MULTILINE)[1]) * 1e4
    times = record.times.astype(object)
    (scratch / rain_file).write_text("".join(
        f"{station} {time:%Y %m %d %H %M} {rain:.6f}\n"
        for time, rain in zip(times, np.nan_to_num(record.rain), strict=True) if rain > 0
    ), encoding="utf-8")
    (scratch / temperature_file).write_text("".join(
        f"{station} {' '.join(date.split('-'))} {maximum} {minimum}\n"
        for date, (maximum, minimum)
        in temperatures(directory / f"{roof.name}_temperature_daily.txt").items()
    ), encoding="utf-8")
    model = scratch / f"{roof.name}-swmm.inp"
    model.write_text(
        # An initial deficit is a share, at most 1; SWMM 5.2 refuses the file's value, 4. It has no
        # effect, because everything except the roof is sealed in both subcatchments.
        re.sub(r"(?m)^(S1\s+3\.0\s+0\.5\s+)4\b(?=\s*$)", r"\g<1>0.4", text)
        .replace(f'"{rain_file}"', f'"{scratch / rain_file}"')
        .replace(f'"{temperature_file}"', f'"{scratch / temperature_file}"'), encoding="utf-8"
    )
    with Simulation(str(model), outputfile=str(scratch / f"{roof.name}-result.out")) as running:
        running.step_advance(86400)  # avoids a message for every hour
        for _ in running:
            pass
    outfall = re.search(r"\[OUTFALLS\]\n(?:;.*\n)*(\S+)", text)[1]
    with Output(str(scratch / f"{roof.name}-result.out")) as output:
        flow = output.node_series(outfall, NodeAttribute.TOTAL_INFLOW)  # l/s
    result = np.full(record.steps, np.nan)
    first = record.times[0]
    for time, litres in flow.items():
        # A result is for an instant, the end of its step.
        step = int((np.datetime64(time, "s") - first) / np.timedelta64(STEP_S, "s")) - 1
        if 0 <= step < record.steps:
            result[step] = litres * STEP_S / area
    return result


def bucket(record: RoofRecord, steps: NDArray[np.bool_]) -> Values:
    """Fit a bucket's one parameter, its depth (mm), and return its runoff (mm).

    It evaporates like the reference grass while it holds water, and water that it cannot hold runs
    off at once.
    """
    rain, potentials = np.nan_to_num(record.rain).tolist(), record.reference.tolist()
    seconds = record.seconds[steps]
    measured = sums(record.runoff[steps], seconds, 3600)

    def run(depth: float) -> Values:
        stored, runoff = depth / 2, []
        for water, potential in zip(rain, potentials, strict=True):
            stored = max(0.0, stored + water - potential)
            runoff.append(max(0.0, stored - depth))
            stored = min(stored, depth)
        return np.array(runoff)

    def misfit(depth: float) -> float:
        return float(np.sum((sums(run(depth)[steps], seconds, 3600) - measured) ** 2))

    depths = np.arange(5.0, 120.0, 5.0)
    best = float(depths[np.argmin([misfit(depth) for depth in depths])])
    return run(minimize_scalar(misfit, bounds=(best - 5, best + 5), method="bounded").x)
