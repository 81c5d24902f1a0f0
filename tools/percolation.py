"""Compare the model of a green roof with the runoff of two measured roofs.

``python tools/percolation.py --neubrandenburg FILE... --berlin FILE...`` fits the model to each
half of the warm months, with several exponents of percolation, and judges it by the other half. It
prints the tables of doc/explanation/roof.md, in a minute or two. The files are those of
Kompetenzzentrum Wasser Berlin (github.com/KWB-R/keys.lid, MIT License, inst/extdata): the tables
of rain and of runoff (mm in five minutes) in rawdata/validation_data_green_roof, and at last the
daily temperatures, obs_temp_daily_*.txt in validation/green_roof.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from greenroof_ros.analysis.calibration.fit import (
    Fit,
    find_min_reading,
    fit_exponents,
    simulate,
)
from greenroof_ros.analysis.calibration.record import (
    HOUR_S,
    StepRecord,
    Steps,
    Values,
    combine,
    find_storms,
    halve_steps,
    read_csv_record,
    score,
    select_months,
)
from greenroof_ros.analysis.calibration.result import complete_roof
from greenroof_ros.base.files import default_site_file
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

MONTHS = "4-10"
EXPONENTS = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0)
ROOFS = {
    "Neubrandenburg": {"a2": 101.0, "z_soil": 0.108, "latitude": 53.56, "longitude": 13.26},
    "Berlin": {"a2": 194.0, "z_soil": 0.1, "latitude": 52.52, "longitude": 13.40},
}
_STORMS = 10
_STEP_S = 300


@dataclass(frozen=True)
class Half:
    """A half of a record, and the fits to the other half, by exponent."""

    record: StepRecord
    steps: Steps
    fits: dict[float, Fit]


def read_roof(files: Sequence[Path], site: Site) -> StepRecord:
    """Return the record in a roof's files, in steps of five minutes."""
    *tables, temperatures = files
    series = {}
    for file in tables:
        table = pd.read_csv(file, sep="[,;]", engine="python", index_col=0, parse_dates=True)
        for name, values in table.items():
            kind = str(name).partition(" ")[0]
            series[f"{kind} [mm]"] = values.resample(f"{_STEP_S}s").sum(min_count=1)
    daily = pd.read_csv(temperatures, sep=r"\s+", header=None)
    days = pd.to_datetime(daily[[1, 2, 3]].set_axis(["year", "month", "day"], axis=1))
    for name, extreme in (("maximum", daily[[4, 5]].max(axis=1)),
                          ("minimum", daily[[4, 5]].min(axis=1))):
        series[f"{name} temperature [degC]"] = pd.Series(extreme.to_numpy(), days)
    whole = pd.DataFrame(series).sort_index()
    measured = whole.filter(like="[mm]").dropna(how="all").index
    with tempfile.TemporaryDirectory() as directory:
        copy = Path(directory) / "roof.csv"
        whole[measured[0]:measured[-1]].to_csv(
            copy, index_label="time", date_format="%Y-%m-%dT%H:%M"
        )
        return read_csv_record(copy, site)


def fit_roof(files: Sequence[Path], name: str) -> list[Half]:
    """Fit a roof to each half of its record; return both halves."""
    site = complete_roof(read_site(default_site_file(), {**ROOFS[name], "utc_offset": 1.0}))
    record = read_roof(files, site)
    halves = [*halve_steps(record, select_months(record, MONTHS)).values()]
    result = []
    for fitted, judged in (halves, halves[::-1]):
        fits = fit_exponents(
            site, record, {"fit": fitted, "validation": judged}, exponents=EXPONENTS
        )
        result.append(Half(record, judged, dict(zip(EXPONENTS, fits, strict=True))))
    return result


def print_table(*rows: Sequence[str]) -> None:
    """Print rows in Markdown, the header first."""
    head, *others = rows
    for row in (head, ["---"] * len(head), *others):
        print(f"| {' | '.join(row)} |")
    print()


def score_exponents(halves: Sequence[Half], exponent: float) -> list[str]:
    """Return the NSE over steps, hours and days, and the ratio of volumes: means of both halves."""
    rows = []
    for half in halves:
        record, steps = half.record, half.steps
        scored = score(
            "runoff", "validation", half.fits[exponent].simulated["runoff"], record, steps
        )
        rows.append([*scored.nse.values(), 1 + scored.volume_error])
    return [f"{value:.2f}" for value in np.mean(rows, axis=0)]


def show_parameters(half: Half) -> Iterator[str]:
    """Yield the parameters that were fitted to the other half, with their intervals."""
    fit = half.fits[2.0]
    known = {parameter.name: parameter for parameter in fit.parameters}
    storage = fit.site.drainage_storage
    for name, factor in (("field_capacity", 1.0), ("depletion_fraction", 1.0),
                         ("drainage_time", storage), ("crop_coefficient", 1.0)):
        value, low, high = (f"{float(f'{factor * end:.2g}'):g}" for end in known[name][1:4])
        yield f"{value} ({'not fitted' if low == 'nan' else f'{low} to {high}'})"


def find_peaks(values: Values, storms: Sequence[slice], steps: int) -> Values:
    """Return the peak of each storm over a number of steps (mm/h)."""
    moving = (np.convolve(values[storm], np.ones(steps), "valid").max() for storm in storms)
    return np.fromiter(moving, float) * HOUR_S / _STEP_S / steps


def compare_peaks(halves: Sequence[Half]) -> Iterator[tuple[Values, Values, Values]]:
    """Yield peaks over 5, 15 and 60 minutes in the ten storms with the highest 5-minute runoff.

    Yields:
        Measured peaks, and those simulated with rain every five minutes and every hour (mm/h).
    """
    series, storms = [], []
    for half in halves:
        record, fit = half.record, half.fits[2.0]
        rain = np.nan_to_num(record.rain)
        _, hour = np.unique(record.seconds // HOUR_S, return_inverse=True)
        hourly = replace(record, rain=combine("level", rain, record.seconds, HOUR_S)[hour])
        shown = simulate(fit.site, hourly, fit.filled, find_min_reading(record))
        each = record.measured["runoff"], fit.simulated["runoff"], shown["runoff"]
        series.append(each)
        storms.append([storm for storm in find_storms(record) if half.steps[storm].all()])
    for steps in (1, 3, 12):
        peaks = np.concatenate([
            [find_peaks(values, of_half, steps) for values in each]
            for each, of_half in zip(series, storms, strict=True)
        ], axis=1)
        if steps == 1:
            highest = np.argsort(-peaks[0])[:_STORMS]
        yield tuple(peaks[:, highest])


def show_peaks(halves: Sequence[Half]) -> Iterator[list[str]]:
    """Yield the rows of the table of peaks of a roof."""
    measured, *simulated = (np.stack(each) for each in zip(*compare_peaks(halves), strict=True))
    yield ["measured peak, mm/h", *(f"{peak:.2f}" for peak in measured.mean(axis=1))]
    for what, form, compute in (
        ("simulated relative to measured peak", ".2f",
         lambda peaks: peaks.sum(axis=1) / measured.sum(axis=1)),
        ("mean error of a storm's peak", ".0%",
         lambda peaks: np.mean(np.abs(peaks / measured - 1), axis=1)),
    ):
        for rain, peaks in zip(("5-minute", "hourly"), simulated, strict=True):
            yield [f"{what}, {rain} rain", *(f"{value:{form}}" for value in compute(peaks))]


def main() -> None:
    """Print the tables of the roofs whose files the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ROOFS:
        parser.add_argument(
            f"--{name.lower()}", type=Path, nargs="+", required=True, metavar="FILE"
        )
    files = vars(parser.parse_args())
    roofs = {name: fit_roof(files[name.lower()], name) for name in ROOFS}
    spans = ("5 min", "1 h", "1 day", "volume")
    print_table(
        ["exponent", *(f"{name}, {span}" for name in roofs for span in spans)],
        *([f"{exponent:g}", *(cell for halves in roofs.values()
                             for cell in score_exponents(halves, exponent))]
          for exponent in EXPONENTS),
    )
    columns = [
        [f"{name}, {half}", *show_parameters(of_half)]
        for name, halves in roofs.items()
        for half, of_half in zip(("earlier", "later"), halves, strict=True)
    ]
    names = "", "field capacity", "depletion fraction", "$h T$ (m s)", "crop coefficient"
    print_table(*zip(names, *columns, strict=True))
    for name, halves in roofs.items():
        print_table([name, "5 min", "15 min", "60 min"], *show_peaks(halves))


if __name__ == "__main__":
    main()
