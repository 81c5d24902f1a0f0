"""Fit a site's roof to a measured record: ``greenroof calibrate MEASURED``."""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from greenroof_ros.analysis.calibration.bag_record import read_bag_record
from greenroof_ros.analysis.calibration.checks import check_fit, check_record
from greenroof_ros.analysis.calibration.csv_record import read_csv_record
from greenroof_ros.analysis.calibration.fit import Fit, complete_roof, lower_target
from greenroof_ros.analysis.calibration.percolation import EXPONENTS, choose_exponent, fit_exponents
from greenroof_ros.analysis.calibration.record import (
    halve_steps,
    read_months,
    select_comparable,
    select_months,
)
from greenroof_ros.analysis.calibration.scores import FitScores, score
from greenroof_ros.analysis.calibration.site_file import (
    INTERVAL_NOTE,
    format_fitted_site,
    list_fit_entries,
)
from greenroof_ros.analysis.calibration.step_record import DAY_S, StepRecord, Steps, name_time
from greenroof_ros.base.command_line import Parser, add_site, command, print_lines
from greenroof_ros.base.console import PlainConsole
from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.commands.output_file import refuse_unwritable
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

_DESCRIPTION = """\
Fit a site's roof parameters to a measured record: field capacity, wilting point, depletion
fraction, drainage time and crop coefficient, as far as the record determines them, and the exponent
of percolation, which is changed only if the validation tells it apart. The model is fitted to the
first half of the rain and validated on the second half.
"""
_EPILOG = """\
MEASURED is a bag recorded by this project, or a CSV file with rows at most a day apart. Empty cells
and missing rows are treated as gaps. The columns are:

  time, rain [mm], runoff [mm], level [m], temperature [degC]

The model does not include snow. If the record covers winters, specify the months to use, as in
--months 4-10.

The command writes the site file and, next to it, a page with the same name but the extension .html.

examples:
  greenroof calibrate roof_2025.csv --site my_site.yaml -o fitted_site.yaml
  greenroof calibrate roof_2024_2025.csv --months 4-10 -o fitted_site.yaml
  greenroof simulate --site fitted_site.yaml

exit codes: 0 done, 2 bad usage, configuration or record, 130 interrupted
"""


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser(prog="greenroof calibrate", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "measured", type=Path, metavar="MEASURED",
        help="measured record: a CSV file, a bag, or an .mcap file",
    )
    add_site(parser, "start the fit from this site file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE.yaml",
        help="write the fitted site to this file, which must not exist yet",
    )
    parser.add_argument(
        "--months", metavar="FIRST-LAST",
        help="fit and validate with only these months of the record, such as 4-10, or 11-3 for a "
        "period that spans the new year; the other months are only simulated (default: all)",
    )
    return parser


@command
def main() -> None:
    """Fit the record named on the command line."""
    arguments = make_parser().parse_args()
    output: Path = arguments.output
    page_file = output.with_suffix(".html") if output.name else output
    refuse_unwritable(output, ".yaml", ".yml")
    refuse_unwritable(page_file, ".html")
    if arguments.months is not None:
        read_months(arguments.months)
    text, page = _calibrate(arguments.measured, arguments.months, arguments.site)
    for file, content in ((page_file, page), (output, text)):
        with add_path_to_errors(file):
            file.write_text(content, encoding="utf-8")
    PlainConsole().print(f"written: {output}, {page_file}", soft_wrap=True)


def _calibrate(measured: Path, months: str | None, site_file: Path) -> tuple[str, str]:
    """Fit a record, print the result, and return the texts of the site file and the page.

    Args:
        measured: the record.
        months: months of the record to use, in the format of --months; None for all.
        site_file: site file from which the fit starts.
    """
    with require_extra("study"):
        from greenroof_ros.analysis.calibration.page import render

    site = complete_roof(read_site(site_file))
    if measured.is_dir() or measured.suffix.lower() == ".mcap":
        record = read_bag_record(measured, site)
    else:
        record = read_csv_record(measured, site, months)
    print_lines("record", record.contents)
    print_lines("note", record.notes)
    counts = select_months(record, months)
    counted = record.select(counts)
    warnings = check_record(counted, site)
    print_lines("warning", warnings)
    halves = halve_steps(record, select_comparable(record) & counts)
    _refuse_dry(record, halves)
    own = site.percolation_exponent
    with ProgressBar() as progress:
        fits = fit_exponents(site, record, halves, progress.show, sorted({*EXPONENTS, own}))
    fitted, of_exponents = choose_exponent(fits, own)
    fitted = fitted._replace(site=lower_target(fitted.site))
    rows = [
        score(
            name, part, getattr(fitted.simulated, name)[steps], series[steps],
            record.seconds[steps], record.step_s,
        )
        for name, series in record.measured.items() for part, steps in halves.items()
    ]
    warnings += check_fit(rows, measured)
    notes = [*_list_notes(record, halves, site, fitted.site), of_exponents]
    spans = {part: _name_span(record, steps) for part, steps in halves.items()}
    entries = list_fit_entries(fitted, site.z_veg)
    heading = _write_heading(measured, spans, rows, notes + warnings)
    text = format_fitted_site(site_file, entries, heading)
    page = render(counted, halves, fitted, rows, text, spans, warnings, [*record.contents, *notes])
    print("\n".join(heading))
    _print_parameters(fitted)
    return text, page


def _list_notes(
    record: StepRecord, halves: Mapping[str, Steps], before: Site, fitted: Site
) -> list[str]:
    """Return notes for the user about the fit, in addition to the parameters and scores."""
    days = record.step_s / DAY_S
    compared = sum(int(np.count_nonzero(steps)) for steps in halves.values()) * days
    notes = [
        f"compared: {compared:.3g} of {record.steps * days:.3g} days; the other days have "
        "gaps, are in months that are not used, or follow a time in which a storm may have gone "
        "unrecorded"
    ]
    if fitted.z_veg != before.z_veg:
        notes.append(
            f"target: z_veg was {before.z_veg:g} m, and the fitted roof holds "
            f"{fitted.roof_level(fitted.z_cap):.3g} m; z_veg is set to {fitted.z_veg:g} m, where "
            "half of the plant-available water is left (FAO-56, chapter 8); choose your own target"
        )
    return notes


def _refuse_dry(record: StepRecord, halves: Mapping[str, Steps]) -> None:
    """Reject a record that contains nothing to fit, or nothing to validate the fit against."""
    for half, steps in zip(("first", "second"), halves.values(), strict=True):
        if not steps.any() or all(np.ptp(each[steps]) == 0 for each in record.measured.values()):
            raise ConfigurationError(
                f"in the {half} half of its rain, no measured quantity changes, but fit and "
                "validation both need changes in runoff or levels; leave out the dry rows at the "
                "end, or use a longer record with fewer gaps", file=record.source,
            )


def _name_span(record: StepRecord, steps: Steps) -> str:
    first, last = np.flatnonzero(steps)[[0, -1]]
    return " to ".join(record.time(int(step))[:16] for step in (first, last))


def _write_heading(
    measured: Path, spans: Mapping[str, str], rows: Collection[FitScores],
    notes: Sequence[str],
) -> list[str]:
    lines = [
        f"Fitted to {measured.name} by greenroof calibrate.",
        f"Fit: {spans['fit']}; validation: {spans['validation']}.",
    ]
    for row in rows:
        nse = ", ".join(
            f"{value:.2f} ({name_time(span_s)})" for span_s, value in row.nse.items()
        )
        span_s, kge = list(row.kge.items())[-1]
        volume = f"; volume {100 * row.volume_error:+.1f} %" if row.quantity == "runoff" else ""
        lines.append(
            f"{row.quantity}, {row.part}: NSE {nse}; KGE {kge:.2f} ({name_time(span_s)}){volume}."
        )
    lines += [INTERVAL_NOTE, *notes]
    return [line for text in lines for line in textwrap.wrap(text, 98)]


def _print_parameters(fitted: Fit) -> None:
    table = Table(
        "parameter", "value", "95 % interval", "", title="Parameters", title_justify="left"
    )
    for parameter in fitted.parameters:
        table.add_row(
            parameter.name, f"{parameter.value:.4g}", parameter.interval or "not fitted",
            parameter.reason,
        )
    PlainConsole().print(table)
