"""Two roofs with records, Neubrandenburg and Berlin: ``python tools/measured_roofs DIRECTORY``.

Each roof is fitted on one half of its warm seasons and judged on the other, both ways, and compared
with SWMM as its authors calibrated it and with a bucket of one parameter. Needs the extras [study]
and [swmm]. With ``--parts`` each roof is instead fitted on its earlier half without each part of
the model in turn, to see what the part gains on the later half; config/site_neubrandenburg.yaml is
judged there too.

DIRECTORY holds for each roof NAME, neubrandenburg and berlin, files from KWB-R/keys.lid:
NAME.inp, its model for SWMM 5; NAME_temperature_daily.txt, a line for each day: station, year,
month, day, maximum and minimum temperature (degC); and CSV compressed by xz, with columns
"time" (ISO 8601, local), "rain [mm/5min]" and "runoff [mm/5min]": neubrandenburg_5min.csv.xz has
both, berlin_rain_5min.csv.xz and berlin_runoff_5min.csv.xz have one each.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import altair as alt
import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from markdown_tables import head, row
from measured_roofs.others import bucket, swmm
from measured_roofs.roofs import ROOFS, STEP_S, read_roof, warm

from greenroof_ros.analysis.calibration import simulation
from greenroof_ros.analysis.calibration.fit import fit, measured_roof
from greenroof_ros.analysis.calibration.record import comparable, halve, storms
from greenroof_ros.analysis.calibration.scores import score
from greenroof_ros.analysis.calibration.simulation import least_reading
from greenroof_ros.analysis.report.drawing import COLOURS, SHAPES, Figure, Panel, cycled
from greenroof_ros.common.files import shared_directory
from greenroof_ros.model.site import read_site
from greenroof_ros.model.soil import MeasuredSoil

OURS, SWMM, BUCKET = MODELS = "calibrated", "SWMM", "bucket"
MIN_MM = 5.0


def start_site(roof):
    """Return the site that the fit begins with: typical values, and the roof's size and place."""
    site = read_site(shared_directory() / "config" / "site.yaml")
    return measured_roof(replace(
        site, a2=roof.area, z_soil=roof.soil, latitude=roof.latitude, longitude=roof.longitude,
        utc_offset=1.0,
    ))


def scored(record, runoff, steps):
    """Return the scores of a runoff in some steps."""
    return score(
        "runoff", "", runoff[steps], record.runoff[steps], record.seconds[steps], record.step_s
    )


class Answer(NamedTuple):
    """A roof's response to a storm."""

    peak: float
    """largest runoff in a quarter of an hour (mm/h)"""
    delay: float
    """time from when half of the rain has fallen until that peak (min)"""
    volume: float
    """runoff (mm)"""


def answer(storm, record, runoff):
    """Return the response in a storm, from a runoff (mm in each step)."""
    within = runoff[storm.first:storm.end]
    fallen = np.cumsum(np.nan_to_num(record.rain[storm.first:storm.end]))
    half = int(np.searchsorted(fallen, fallen[-1] / 2))
    quarters = np.convolve(within, np.ones(3), "valid")
    peak = int(np.argmax(quarters))
    delay = (peak + 1 - half) * STEP_S / 60 if quarters[peak] > 0 else np.nan
    return Answer(float(quarters[peak]) * 4, delay, float(within.sum()))


def judge(roof, directory, scratch):
    """Return rows of scores, measured and simulated responses to storms, and notes."""
    site = start_site(roof)
    record = read_roof(roof, directory, site, scratch)
    theirs = swmm(roof, directory, record, scratch)
    counted = comparable(record) & warm(record) & ~np.isnan(theirs)
    halves = tuple(halve(record, counted).values())
    minimum = least_reading(record)
    missing = np.isnan(record.runoff) & warm(record)
    broken = sum(missing[storm.first:storm.end].any() for storm in storms(record))
    rows, answers = [], []
    notes = [
        f"{roof.name}: the meter's maximum value is {np.nanmax(record.runoff):.3f} mm. The "
        f"{broken} storms with a step without one are left out for every model."
    ]
    for half, fitted_on, judged_on in (("earlier", 0, 1), ("later", 1, 0)):
        fitted = fit(site, record, halves[fitted_on])
        simple = bucket(record, halves[fitted_on])
        models = {
            OURS: fitted.simulated.runoff, SWMM: np.where(theirs < minimum, 0.0, theirs),
            BUCKET: np.where(simple < minimum, 0.0, simple),
        }
        notes += [
            f"{roof.name}, fitted on the {half} half: {fit_of.name} = {fit_of.value:.4g}"
            + (f" ({fit_of.interval})" if fit_of.interval else "")
            + (f"; {fit_of.reason}" if fit_of.reason else "")
            for fit_of in fitted.parameters
        ]
        steps = halves[judged_on]
        rows += [(roof.name, model, scored(record, runoff, steps))
                 for model, runoff in models.items()]
        for storm in storms(record):
            if storm.rain >= MIN_MM and steps[storm.first:storm.end].all():
                measured = answer(storm, record, record.runoff)
                answers += [(roof.name, model, measured, answer(storm, record, runoff))
                            for model, runoff in models.items()]
    return rows, answers, notes


class NoLayer(MeasuredSoil):
    """Percolation leaves the roof at once."""

    def layer_outflow(self, layer, inflow, seconds):
        """Return the outflow (m3/s)."""
        return inflow


class NoStress(MeasuredSoil):
    """Plants take up as much water from a dry soil as from a wet one."""

    def water_stress(self, x2):
        """Return the share of the evapotranspiration demand that plants take up."""
        return 1.0


class NoPercolation(MeasuredSoil):
    """There is no percolation below field capacity."""

    def mean_percolation(self, x2, arriving, seconds):
        """Return the percolation (m3/s)."""
        return max(0.0, x2 - self._capacity) / seconds


PARTS = {
    "all of it": MeasuredSoil, "without the drainage layer": NoLayer,
    "without water stress": NoStress, "without percolation below field capacity": NoPercolation,
}


def parts(roof, directory, scratch):
    """Yield a row for each part of the model: the scores without it."""
    site = start_site(roof)
    record = read_roof(roof, directory, site, scratch)
    earlier, later = halve(record, comparable(record) & warm(record)).values()
    for part, soil in PARTS.items():
        simulation.MeasuredSoil = soil  # the class from which a simulation makes its soil
        runoff = fit(site, record, earlier).simulated.runoff
        yield part_row(roof, part, record, runoff, later)
    simulation.MeasuredSoil = MeasuredSoil
    shipped = shared_directory() / "config" / f"site_{roof.name}.yaml"
    if shipped.exists():
        site = read_site(shipped)
        # Begins half full, as the meter would show it.
        runoff = simulation.simulate(site, record, 0.5, least_reading(record)).runoff
        yield part_row(roof, shipped.name, record, runoff, later)


def part_row(roof, model, record, runoff, steps):
    """Return a row of the scores of a runoff."""
    return _row(roof.name, model, [scored(record, runoff, steps)])


def _row(roof, model, scores):
    """Return a row of mean scores, in Markdown."""
    nse = [f"{np.mean([of_half.nse[time] for of_half in scores]):.2f}" for time in scores[0].nse]
    volume = 1 + np.mean([of_half.volume_error for of_half in scores])
    return row([roof, model, *nse, f"{volume:.2f}"])


def table(rows, notes):
    """Return the means of both halves as a table in Markdown, with the notes below it."""
    lines = [head(["roof", "model", "NSE 5 min", "NSE 1 h", "NSE 1 day", "volume"])]
    for roof in ROOFS:
        for model in MODELS:
            lines.append(_row(roof.name, model, [
                scores for *of, scores in rows if of == [roof.name, model]
            ]))
    return "\n".join([*lines, "", *(f"- {note}" for note in notes)]) + "\n"


def figure(answers):
    """Return the scatter of storms: peak, delay and volume against the measured.

    The bucket is left out, since it has no runoff in most storms. The axes of peak and volume are
    of square roots, since most storms are small.
    """
    series = [f"{roof.name.title()}: {model}" for roof in ROOFS for model in (OURS, SWMM)]
    legend = alt.Legend(columns=2, columnPadding=20)
    panels, data = [], {}
    for what, title in (("peak", "peak (mm/h)"), ("delay", "delay (min)"),
                        ("volume", "volume (mm)")):
        points = [
            {"series": f"{roof.title()}: {model}", "m": getattr(measured, what),
             "s": getattr(simulated, what)}
            for roof, model, measured, simulated in answers if model != BUCKET
        ]
        data[what] = [point for point in points if np.isfinite([point["m"], point["s"]]).all()]
        ends = [point[axis] for point in data[what] for axis in ("m", "s")]
        low, high = min(0.0, *ends), max(ends)
        scale = alt.Scale(domain=[low, high], type="linear" if low < 0 else "sqrt")
        line = alt.Chart(alt.InlineData([{"v": low}, {"v": high}])).mark_line(
            color="#888888", strokeWidth=1).encode(x="v:Q", y="v:Q")
        marks = alt.Chart(alt.NamedData(what)).mark_point(filled=True, size=35, opacity=0.7).encode(
            x=alt.X("m:Q", title=f"measured {title}", scale=scale),
            y=alt.Y("s:Q", title=f"simulated {title}", scale=scale),
            color=alt.Color("series:N", title=None, legend=legend, scale=cycled(COLOURS, series)),
            shape=alt.Shape("series:N", title=None, legend=legend, scale=cycled(SHAPES, series)),
        )
        panels.append(Panel(alt.layer(line, marks), title, height=260))
    return Figure("storms", "Storms of the half that was not fitted", "", tuple(panels), 1, data)


def main():
    """Compare, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path, help="with the files of both roofs")
    parser.add_argument("--output", type=Path, help="directory for tables and figure")
    parser.add_argument(
        "--parts", action="store_true", help="only show what each part of the model gains"
    )
    arguments = parser.parse_args()
    if arguments.parts:
        with tempfile.TemporaryDirectory() as scratch:
            for roof in ROOFS:
                for line in parts(roof, arguments.directory, Path(scratch)):
                    print(line, flush=True)
        return
    rows, answers, notes = [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        for roof in ROOFS:
            of_roof = judge(roof, arguments.directory, Path(scratch))
            for every, more in zip((rows, answers, notes), of_roof, strict=True):
                every.extend(more)
    text = table(rows, notes)
    print(text)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "measured_roofs.md").write_text(text, encoding="utf-8")
        figure(answers).save(arguments.output)


if __name__ == "__main__":
    main()
