"""Fit a site's roof to what was measured on it: ``greenroof calibrate MEASURED``."""

from __future__ import annotations

import argparse
import os
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from greenroof_ros.calibration.bag_record import read_bag_record
from greenroof_ros.calibration.csv_record import read_csv_record
from greenroof_ros.calibration.dry_nights import dry_nights
from greenroof_ros.calibration.fit import Fit, fit, measured_roof
from greenroof_ros.calibration.halves import Halves, halve
from greenroof_ros.calibration.months import Months, counted
from greenroof_ros.calibration.pump import fit_pump
from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.scores import ScoreRow, Scores, score, time_name
from greenroof_ros.calibration.sentences import (
    of_months,
    of_pump,
    of_sensor,
    of_sheet,
    of_target,
)
from greenroof_ros.calibration.site_file import (
    CROP_NOTE,
    INTERVAL_NOTE,
    fitted_site_file,
    pump_site_file,
    refuse_other_forms,
    refuse_unlike,
)
from greenroof_ros.calibration.storms import comparable
from greenroof_ros.calibration.suspicions import refuse_wrong
from greenroof_ros.calibration.target import reachable_target
from greenroof_ros.calibration.verdict import refuse_hopeless, warning
from greenroof_ros.common.command_line import EXIT_DONE, command
from greenroof_ros.common.errors import ConfigurationError, in_extra
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.progress_lines import ProgressLines
from greenroof_ros.model.pump_curve import PumpCurve, fit_pump_curve
from greenroof_ros.model.site import Site, edited, read_site

_DESCRIPTION = """\
Fit the roof of a site to a measured record: its field capacity, wilting point, depletion fraction,
drainage time and crop coefficient, as far as the record can tell them. The first half of its rain
is fitted, the second judges the fit. Where the record has the pumps' state and the cistern's level,
the pump curve is fitted first, to how fast the cistern falls.
"""
_EPILOG = """\
MEASURED is a bag of this project, or CSV: a row a step, at most a day apart, and columns named
like these, in which empty cells and missing rows are gaps:

  time, rain [mm], runoff [mm], level [m], temperature [degC]

  rain                         mm, mm/h, mm/5min
  runoff, pumped               mm, l, m3, and with /s, /min, /5min, /h, /day
  level, cistern level         m, cm, mm
  pump state                   1, %; needs the cistern level
  reference evapotranspiration mm, mm/h, mm/day; or instead of it
  temperature                  degC; or least temperature and greatest temperature of the day

The model knows no snow: where winters were recorded, say which months count, as in --months 4-10.

Written are the site file, and a page beside it with its name and .html. With --pump-data and no
MEASURED the site file alone, with the pumps of the data sheet.

examples:
  greenroof calibrate roof_2025.csv --site my_site.yaml -o fitted_site.yaml
  greenroof calibrate roof_2024_2025.csv --months 4-10 -o fitted_site.yaml
  greenroof calibrate --pump-data sheet.csv --site my_site.yaml -o fitted_site.yaml
  greenroof simulate --site fitted_site.yaml

exit codes: 0 done, 2 bad usage, configuration or record, 130 interrupted
"""


def make_parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    parser = argparse.ArgumentParser(
        prog="greenroof calibrate", description=_DESCRIPTION, epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "measured", type=Path, nargs="?", metavar="MEASURED",
        help="the record, CSV or a bag; not needed with --pump-data",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site file that the fit begins with (default: the paper's, config/site.yaml)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.yaml",
        help="site file to write; not one that exists",
    )
    parser.add_argument(
        "--pump-data", type=Path, metavar="FILE.csv",
        help="points of the pumps' data sheet, to fit their curve to: lines of "
        "'flow [m3/s],head [m]'",
    )
    parser.add_argument(
        "--months", metavar="FIRST-LAST",
        help="months of the record that are fitted and judged, such as 4-10, or 11-3 over new "
        "year; the others are simulated only (default: all)",
    )
    return parser


@command
def main() -> int:
    """Fit the record that the command line names."""
    arguments = make_parser().parse_args()
    output: Path = arguments.output
    page_file = output.with_suffix(".html") if output.name else output
    _check_output(output, page_file)
    if arguments.measured is None and arguments.pump_data is None:
        raise ConfigurationError("must be given, or --pump-data alone", key="MEASURED")
    months = None if arguments.months is None else Months(arguments.months)
    site_file: Path = arguments.site or shared_directory() / "config" / "site.yaml"
    site = read_site(site_file)
    refuse_other_forms(site_file)
    text = edited(site_file, {})
    sheet = None
    notes = []
    if arguments.pump_data is not None:
        source = arguments.pump_data.name
        sheet = _read_sheet(arguments.pump_data, site)
        notes.append(of_sheet(sheet))
        site = replace(site, a_hat=sheet.a_hat, c_hat=sheet.c_hat)
        heading = [f"Pumps fitted to {source} by greenroof calibrate."]
        pumps_text = pump_site_file(text, sheet, heading)
        refuse_unlike(pumps_text, site, site_file)
    if arguments.measured is not None:
        if months is not None:
            notes.append(of_months(months))
        fitted, fitted_text, page_text = _fit(
            arguments.measured, months, measured_roof(site), sheet, text, notes
        )
        refuse_unlike(fitted_text, fitted.site, site_file)
        page_file.write_text(page_text, encoding="utf-8")
        output.write_text(fitted_text, encoding="utf-8")
        written = f"{output}, {page_file}"
    else:
        _print_notes(notes)
        output.write_text(pumps_text, encoding="utf-8")
        written = str(output)
    Console().print(f"written: {written}", soft_wrap=True, highlight=False)
    return EXIT_DONE


def _check_output(output: Path, page_file: Path) -> None:
    """Refuse, before minutes of a fit, where its files could not be written."""
    if output.suffix not in (".yaml", ".yml"):
        raise ConfigurationError(
            "must be the name of a file that ends in .yaml", key="--output", value=str(output)
        )
    if not (output.parent.is_dir() and os.access(output.parent, os.W_OK)):
        raise ConfigurationError(
            "must be in a directory that exists and can be written to", key="--output",
            value=str(output),
        )
    for file in (output, page_file):
        if file.exists():
            raise ConfigurationError("exists; name another file", key="--output", value=str(file))


def _read_sheet(file: Path, site: Site) -> PumpCurve:
    """Return the pump curve of a data sheet."""
    with in_extra("study"):
        from greenroof_ros.report.pump_figures import read_pump_data
    points = read_pump_data(file)
    sheet = fit_pump_curve([flow for flow, _ in points], [head for _, head in points])
    if sheet.c_hat - site.d + site.suction_level <= 0:
        raise ConfigurationError(
            f"the curve has {sheet.c_hat:.4g} m at no flow; it must exceed d - z_pump - z_H = "
            f"{site.d - site.suction_level:g} m of the site, or the pumps never lift water to the "
            "roof (Eq. 3e)", file=file,
        )
    return sheet


def _fit(
    measured: Path, months: Months | None, site: Site, sheet: PumpCurve | None, text: str,
    notes: Sequence[str],
) -> tuple[Fit, str, str]:
    """Fit a record, print what was found, and return it with the texts of site file and page.

    Args:
        measured: the record.
        months: of it that count; None for all.
        site: where the fit begins.
        sheet: what was fitted to the pumps' data sheet before.
        text: of the site file.
        notes: what is to be said of the fit already.
    """
    with in_extra("study"):
        from greenroof_ros.calibration import figures, page

    def read(site: Site) -> Record:
        if measured.is_dir():
            return read_bag_record(measured, site)
        return read_csv_record(measured, site, months)

    record = read(site)
    counts = counted(record, months)
    pump = fit_pump(site, record.only(counts))
    if pump is not None:
        site = pump.site
        record = read(site)  # the pumps' state is now another flow
    seen = record.only(counts)
    refuse_wrong(seen, site)
    halves = halve(record, comparable(record) & counts)
    _refuse_dry(record, halves)
    with _Bar() as bar:
        fitted = fit(site, record, halves.earlier, bar.tell)
    fitted = fitted._replace(site=reachable_target(fitted.site))
    notes = [*notes]
    if fitted.site.z_veg != site.z_veg:
        notes.append(of_target(site, fitted.site))
    if record.level is not None:
        notes.append(of_sensor(dry_nights(seen, fitted.simulated.level)))
    if record.command is not None and record.cistern is not None:
        notes.append(of_pump(pump))
    if pump is not None:
        fitted = fitted._replace(parameters=[*fitted.parameters, *pump.parameters])
    spans = {
        part: _span(record, steps)
        for part, steps in zip(("fit", "validation"), halves, strict=True)
    }
    rows = [
        ScoreRow(name, part, _scores(record, fitted, name, steps))
        for name in record.measured
        for part, steps in zip(("fit", "validation"), halves, strict=True)
    ]
    refuse_hopeless(record, rows)
    wrong = warning(rows)
    heading = [
        line for one in (*_heading(record, spans, rows), *notes, wrong)
        for line in textwrap.wrap(one, 98)
    ]
    fitted_text = fitted_site_file(text, site, fitted, heading, sheet)
    page_text = page.render(
        seen, fitted, rows, figures.make_figures(record, halves, fitted), fitted_text, spans,
        notes, wrong,
    )
    _print(fitted, rows)
    _print_notes(notes)
    if wrong:
        Console().print(wrong, style="bold", soft_wrap=True, highlight=False)
    return fitted, fitted_text, page_text


def _refuse_dry(record: Record, halves: Halves) -> None:
    """Refuse a record of which a half has nothing measured, or no water."""
    for part, steps in zip(("first", "second"), halves, strict=True):
        moved = any(np.ptp(series[steps]) > 0 for series in record.measured.values()
                    if np.any(steps))
        if not moved:
            raise ConfigurationError(
                f"in the {part} half of its rain nothing that was measured changes; a longer "
                "record, with dry days in it, is needed", file=record.source,
            )


def _scores(record: Record, fitted: Fit, name: str, steps: NDArray[np.bool_]) -> Scores:
    simulated = getattr(fitted.simulated, name)
    return score(
        name, simulated[steps], record.measured[name][steps], record.seconds[steps], record.step_s
    )


def _span(record: Record, steps: NDArray[np.bool_]) -> str:
    times = record.times[steps]
    return " to ".join(str(time)[:16].replace("T", " ") for time in (times[0], times[-1]))


def _heading(record: Record, spans: dict[str, str], rows: Sequence[ScoreRow]) -> list[str]:
    """Return what stands at the top of the site file."""
    lines = [
        f"Fitted to {record.source.name} by greenroof calibrate.",
        f"Fit: {spans['fit']}; validation: {spans['validation']}.",
    ]
    for row in rows:
        nse = ", ".join(
            f"{value:.2f} ({time_name(over_s)})" for over_s, value in row.scores.nse.items()
        )
        line = f"{row.quantity}, {row.part}: NSE {nse}"
        if row.quantity == "runoff":
            line += f"; volume {100 * row.scores.volume_error:+.1f} %"
        lines.append(f"{line}.")
    return [*lines, INTERVAL_NOTE]


def _print(fitted: Fit, rows: Sequence[ScoreRow]) -> None:
    """Print parameters and scores."""
    table = Table(title="Parameters", title_justify="left")
    for name in ("parameter", "value", "95 % interval", ""):
        table.add_column(name)
    for one in fitted.parameters:
        interval = f"{one.low:.4g} to {one.high:.4g}" if one.told else "not fitted"
        table.add_row(one.name, f"{one.value:.4g}", interval, one.words)
    times = list(rows[0].scores.nse)
    scores = Table(title="Scores", title_justify="left")
    scores.add_column("of")
    for name in (*(f"NSE {time_name(time)}" for time in times), "KGE 1 day", "volume"):
        scores.add_column(name, justify="right")
    for row in rows:
        values = [f"{row.scores.nse[time]:.3f}" for time in times]
        values.append(f"{row.scores.kge[times[-1]]:.3f}")
        error = f"{100 * row.scores.volume_error:+.1f} %" if row.quantity == "runoff" else ""
        scores.add_row(f"{row.quantity}, {row.part}", *values, error)
    console = Console()
    console.print(table)
    console.print(INTERVAL_NOTE, soft_wrap=True, highlight=False)
    console.print(f"crop_coefficient {CROP_NOTE}", soft_wrap=True, highlight=False)
    console.print(scores)


def _print_notes(notes: Sequence[str]) -> None:
    """Print what was found beside the roof's parameters."""
    for note in notes:
        Console().print(note, soft_wrap=True, highlight=False)


class _Bar:
    """The bar of a fit on standard error; a line every ten seconds where that is no terminal."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(), console=console,
            transient=True, disable=not console.is_terminal,
            refresh_per_second=2,  # a thread that takes its share of two cores
        )
        self._task = self._progress.add_task("", total=1.0)
        self._lines = None if console.is_terminal else ProgressLines()

    def __enter__(self) -> _Bar:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def tell(self, text: str, share: float) -> None:
        """Show how far it is: see :data:`greenroof_ros.calibration.stages.Tell`."""
        self._progress.update(self._task, description=text, completed=share)
        if self._lines is not None:
            self._lines.tell(f"{text}: {share:.0%}")


if __name__ == "__main__":
    main()
