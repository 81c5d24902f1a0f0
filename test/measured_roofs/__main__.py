"""The measured roofs: ``python test/measured_roofs DIRECTORY``, with the files of both roofs in it.

Each roof is fitted on one half of its warm seasons and judged on the other, both ways, beside SWMM
as its authors calibrated it and a bucket of one parameter. Needs the extras [study] and [swmm].
With ``--parts`` each roof is fitted again without one part of the model after the other instead, on
its earlier half, to see what the part buys on the later one; and config/site_neubrandenburg.yaml is
judged there.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import altair as alt
import numpy as np

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent)]

from answers import answer  # noqa: E402
from others import bucket, swmm  # noqa: E402
from roofs import ROOFS, read_roof, warm  # noqa: E402

from greenroof_ros.calibration import simulation  # noqa: E402
from greenroof_ros.calibration.fit import fit, measured_roof  # noqa: E402
from greenroof_ros.calibration.record import comparable, halve, storms  # noqa: E402
from greenroof_ros.calibration.scores import score  # noqa: E402
from greenroof_ros.calibration.simulation import least_reading  # noqa: E402
from greenroof_ros.common.files import shared_directory  # noqa: E402
from greenroof_ros.model.site import read_site  # noqa: E402
from greenroof_ros.report.drawing import COLOURS, Figure, Panel  # noqa: E402

OURS, SWMM, BUCKET = "fitted roof", "SWMM", "bucket"
LEAST_MM = 5.0
MODELS = (OURS, SWMM, BUCKET)


def start_site(roof):
    """Return the site that the fit begins with: typical values, the roof's own size and place."""
    site = read_site(shared_directory() / "config" / "site.yaml")
    return measured_roof(replace(
        site, a2=roof.area, z_soil=roof.soil, latitude=roof.latitude, longitude=roof.longitude,
        utc_offset=1.0,
    ))


def whole_storms(record, steps):
    """Return the storms of 5 mm or more that lie in some steps as a whole."""
    return [storm for storm in storms(record)
            if storm.rain >= LEAST_MM and steps[storm.first:storm.end].all()]


def judge(roof, directory, scratch):
    """Return rows of scores and of storms, and what the data say about the volumes."""
    site = start_site(roof)
    record = read_roof(roof, directory, site, scratch)
    theirs = swmm(roof, directory, record, scratch)
    counted = comparable(record) & warm(record) & ~np.isnan(theirs)
    halves = tuple(halve(record, counted).values())
    names = ("earlier", "later")
    rows, storm_rows, notes = [], [], []
    for fitted_on, judged_on in ((0, 1), (1, 0)):
        fitted = fit(site, record, halves[fitted_on])
        simple = bucket(record, halves[fitted_on])
        least = least_reading(record)
        models = {
            OURS: fitted.simulated.runoff, SWMM: np.where(theirs < least, 0.0, theirs),
            BUCKET: np.where(simple < least, 0.0, simple),
        }
        for one in fitted.parameters:
            notes.append(
                f"{roof.name}, fitted on the {names[fitted_on]} half: {one.name} = {one.value:.4g}"
                + (f" ({one.low:.4g} to {one.high:.4g})" if one.told else "")
                + (f"; {one.words}" if one.words else "")
            )
        steps = halves[judged_on]
        for model, runoff in models.items():
            scores = score(
                "runoff", names[judged_on], runoff[steps], record.runoff[steps],
                record.seconds[steps], record.step_s,
            )
            rows.append((roof.name, names[judged_on], model, scores))
        for storm in whole_storms(record, steps):
            answers = {"measured": answer(storm, record, record.runoff)} | {
                model: answer(storm, record, runoff) for model, runoff in models.items()
            }
            storm_rows.append((roof.name, str(record.times[storm.first])[:16], storm.rain, answers))
        notes.append(_volumes(roof, names, fitted_on, judged_on, record, halves, models[OURS]))
    return rows, storm_rows, notes


# What stands for a part of the model that is left out.
PARTS = {
    "all of it": {},
    "without the drainage layer": {
        "layer_outflow": lambda site, layer, inflow, seconds: inflow,
    },
    "without water stress": {"water_stress": lambda site, x2: 1.0},
    "without percolation below field capacity": {
        "mean_percolation": lambda site, x2, arriving, seconds: (
            max(0.0, x2 - site.z_cap) / seconds
        ),
    },
}


@contextlib.contextmanager
def left_out(part):
    """Simulate without a part of the model."""
    before = {name: getattr(simulation, name) for name in PARTS[part]}
    vars(simulation).update(PARTS[part])
    try:
        yield
    finally:
        vars(simulation).update(before)


def parts(roof, directory, scratch):
    """Yield a row of what each part of the model buys."""
    site = start_site(roof)
    record = read_roof(roof, directory, site, scratch)
    earlier, later = halve(record, comparable(record) & warm(record)).values()
    for part in PARTS:
        with left_out(part):
            runoff = fit(site, record, earlier).simulated.runoff
        yield part_row(roof, part, record, runoff, later)
    shipped = shared_directory() / "config" / f"site_{roof.name}.yaml"
    if shipped.exists():
        site = read_site(shipped)
        # Half full at first, as the meter would show it.
        runoff = simulation.simulate(site, record, 0.5, least_reading(record)).runoff
        yield part_row(roof, shipped.name, record, runoff, later)


def part_row(roof, model, record, runoff, steps):
    """Return a row of the scores of a runoff."""
    scores = score(
        "runoff", model, runoff[steps], record.runoff[steps], record.seconds[steps], record.step_s
    )
    nse = " | ".join(f"{value:.2f}" for value in scores.nse.values())
    return f"| {roof.name} | {model} | {nse} | {1 + scores.volume_error:.2f} |"


def _volumes(roof, names, fitted_on, judged_on, record, halves, runoff):
    """Say what the data say about a volume: shares of the rain, quantum of the meter, gaps."""
    fit_half, other = halves[fitted_on], halves[judged_on]
    shares = [100 * record.runoff[half].sum() / record.rain[half].sum() for half in
              (fit_half, other)]
    ours = [100 * runoff[half].sum() / record.rain[half].sum() for half in (fit_half, other)]
    total = record.runoff[other].sum()
    excess = runoff[other].sum() - total
    silent = [storm for storm in whole_storms(record, other)
              if record.runoff[storm.first:storm.end].sum() == 0]
    in_silent = sum(runoff[storm.first:storm.end].sum() for storm in silent)
    missing = np.isnan(record.runoff) & warm(record)
    broken = [storm for storm in storms(record) if missing[storm.first:storm.end].any()]
    wet = sum(storm.rain for storm in broken)
    least = least_reading(record)
    meter = f"Steps below {least:.4f} mm count as 0, as in the meter. " if least else ""
    return (
        f"{roof.name}, judged on the {names[judged_on]} half: of the rain run off, measured, "
        f"{shares[0]:.1f} % in the half fitted and {shares[1]:.1f} % in the other; simulated "
        f"{ours[0]:.1f} % and {ours[1]:.1f} %. Simulated less measured {excess:+.1f} mm of "
        f"{total:.1f} mm; {in_silent:.1f} mm are of the {len(silent)} storms of which the meter "
        f"saw nothing. {meter}In "
        f"{missing.sum()} warm steps it has no value; its greatest is "
        f"{np.nanmax(record.runoff):.3f} mm. The {len(broken)} storms with such a step, {wet:.1f} "
        "mm of rain, are left out for every model."
    )


def tables(rows, storm_rows, notes):
    """Return the tables as Markdown."""
    lines = ["| roof | judged on | model | NSE 5 min | NSE 1 h | NSE 1 day | KGE 1 day | volume |",
             "|---|---|---|---|---|---|---|---|"]
    for roof, half, model, scores in rows:
        nse = " | ".join(f"{value:.2f}" for value in scores.nse.values())
        lines.append(f"| {roof} | {half} half | {model} | {nse} | {scores.kge[86400]:.2f} | "
                     f"{1 + scores.volume_error:.2f} |")
    for roof in dict.fromkeys(row[0] for row in rows):
        for model in MODELS:
            mine = [row[3] for row in rows if row[0] == roof and row[2] == model]
            nse = " | ".join(f"{np.mean([one.nse[time] for one in mine]):.2f}"
                             for time in mine[0].nse)
            lines.append(f"| {roof} | mean of both | {model} | {nse} | "
                         f"{np.mean([one.kge[86400] for one in mine]):.2f} | "
                         f"{1 + np.mean([one.volume_error for one in mine]):.2f} |")
    lines += ["", "| roof | storm | rain (mm) | " + " | ".join(
        f"{what}, {model}" for what in ("peak (mm/h)", "delay (min)", "volume (mm)")
        for model in ("measured", *MODELS)) + " |", "|---" * 15 + "|"]
    for roof, time, rain, answers in storm_rows:
        cells = [f"{getattr(answers[model], what):{form}}".replace("nan", "-")
                 for what, form in (("peak", ".2f"), ("delay", ".0f"), ("volume", ".2f"))
                 for model in ("measured", *MODELS)]
        lines.append(f"| {roof} | {time.replace('T', ' ')} | {rain:.1f} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *(f"- {note}" for note in notes)]) + "\n"


def figure(storm_rows):
    """Return the scatter of the storms: peak, delay and volume of each model over the measured."""
    panels, data = [], {}
    for what, title in (("peak", "peak (mm/h)"), ("delay", "delay (min)"),
                        ("volume", "volume (mm)")):
        points = [
            {"roof": roof, "model": model, "m": getattr(answers["measured"], what),
             "s": getattr(answers[model], what)}
            for roof, _, _, answers in storm_rows for model in MODELS
        ]
        data[what] = [point for point in points if np.isfinite([point["m"], point["s"]]).all()]
        ends = [point[axis] for point in data[what] for axis in ("m", "s")]
        low, high = min(0.0, *ends), max(ends)
        scale = alt.Scale(domain=[low, high])
        line = alt.Chart(alt.InlineData([{"v": low}, {"v": high}])).mark_line(
            color="#888888", strokeWidth=1).encode(x="v:Q", y="v:Q")
        marks = alt.Chart(alt.NamedData(what)).mark_point(filled=True, size=35, opacity=0.7).encode(
            x=alt.X("m:Q", title=f"measured {title}", scale=scale),
            y=alt.Y("s:Q", title=f"simulated {title}", scale=scale),
            color=alt.Color("model:N", title=None, scale=alt.Scale(
                domain=list(MODELS), range=list(COLOURS[:len(MODELS)]))),
            shape=alt.Shape("roof:N", title=None),
        )
        panels.append(Panel(alt.layer(line, marks), title, height=320))
    return Figure("storms", "Storm by storm, on the half that was not fitted", "", tuple(panels), 3,
                  data)


def main():
    """Compare, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path, help="with the files of both roofs")
    parser.add_argument("--output", type=Path, help="directory for tables and figure")
    parser.add_argument(
        "--parts", action="store_true", help="what each part of the model buys, and nothing else"
    )
    arguments = parser.parse_args()
    if arguments.parts:
        with tempfile.TemporaryDirectory() as scratch:
            for roof in ROOFS:
                for row in parts(roof, arguments.directory, Path(scratch)):
                    print(row, flush=True)
        return
    rows, storm_rows, notes = [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        for roof in ROOFS:
            one, two, three = judge(roof, arguments.directory, Path(scratch))
            rows += one
            storm_rows += two
            notes += three
    text = tables(rows, storm_rows, notes)
    print(text)
    if arguments.output:
        arguments.output.mkdir(parents=True, exist_ok=True)
        (arguments.output / "measured_roofs.md").write_text(text, encoding="utf-8")
        figure(storm_rows).save(arguments.output)


if __name__ == "__main__":
    main()
