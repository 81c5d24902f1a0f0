"""Fit a site's roof to a measured record.

The parameters are field capacity, wilting point, depletion fraction, drainage time and crop
coefficient, as far as the record determines them, and the exponent of percolation, which is changed
only if the validation tells it apart. The model is fitted to the first half of the rain and
validated on the second half.

MEASURED is a bag recorded by this project, or a CSV file with rows at most a day apart. Empty cells
and missing rows are treated as gaps. The columns are:

  time, rain [mm], runoff [mm], level [m], temperature [degC]

The model does not include snow. If the record covers winters, specify the months to use, as in
--months 4-10. The command writes the site file and, next to it, a page with the same name but the
extension .html.

Examples:
  greenroof calibrate roof_2025.csv --site my_site.yaml -o fitted_site.yaml
  greenroof calibrate roof_2024_2025.csv --months 4-10 -o fitted_site.yaml
  greenroof simulate --site fitted_site.yaml

Exit codes: 0 done, 2 bad usage, configuration or record, 130 interrupted
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.analysis.calibration.result import calibrate, describe_scores
from greenroof_ros.base.command_line import (
    Parser,
    add_site,
    command,
    print_lines,
    refuse_unwritable,
)
from greenroof_ros.base.console import PlainConsole, ProgressBar
from greenroof_ros.base.errors import rename_keys, require_extra
from greenroof_ros.base.files import add_path_to_errors


def make_parser() -> Parser:
    """Return the command's parser."""
    parser = Parser.of("calibrate", __doc__, "MEASURED -o FILE.yaml [options]")
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
    refuse_unwritable(arguments.output, ".yaml", ".yml")
    page_file = arguments.output.with_suffix(".html")
    refuse_unwritable(page_file, ".html")
    with require_extra("study"):
        from greenroof_ros.analysis.calibration.page import render
    with ProgressBar() as progress, rename_keys({"months": "--months"}):
        made = calibrate(arguments.measured, arguments.site, arguments.months, progress.show)
    print_lines("note", made.notes)
    for file, content in ((page_file, render(made)), (arguments.output, made.site_file)):
        with add_path_to_errors(file):
            file.write_text(content, encoding="utf-8")
    console = PlainConsole()
    console.print("\n".join(map(describe_scores, made.fit.scores)))
    console.print_table("Parameters", ["parameter", "value", "95 % interval", ""], [
        [each.name, f"{each.value:.4g}", each.interval or "not fitted", each.reason]
        for each in made.fit.parameters
    ])
    console.print(f"written: {arguments.output}, {page_file}", soft_wrap=True)
