"""Evaluate and plot runs on a single page that can be viewed in any browser and printed.

The output consists of report.html, and all figures as SVG and PNG in figures/. A bag must contain
/cistern/level, /roof/level, /pump/command and /pump/flow, possibly in a namespace. If any other
topic is missing, its values are taken to be 0, and the report notes this.

Examples:
  greenroof report studies/paper                   a study
  greenroof report runs/a runs/b --output both     runs or simulations, overlaid
  greenroof report bag --site my_site.yaml         a bag of a real site
"""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.base.console import ProgressBar
from greenroof_ros.base.errors import require_extra
from greenroof_ros.base.text import escape

_PAGE = "report.html"


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser.of("report", __doc__, "PATH ... [options]")
    parser.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH",
        help="directory of a study or a run, a bag, or an .mcap file",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR",
        help="write the report to this directory, in place of an earlier report; other files are "
        "rejected (default: report in the first PATH)",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site file of the bags (default: configuration/site.yaml next to each bag, or the "
             "paper's site)",
    )
    return parser


@command
def main() -> None:
    """Make the report that the command line describes."""
    arguments = make_parser().parse_args()
    with require_extra("study"):
        from greenroof_ros.analysis.page import claim_output, write_output
        from greenroof_ros.analysis.report.figures import make_figures
        from greenroof_ros.analysis.report.page import answer, render
        from greenroof_ros.analysis.report.runs import Report, find_runs
    output: Path = arguments.output or arguments.paths[0] / "report"
    with ProgressBar() as progress:
        progress.show("reading", 0.0)
        report = Report(find_runs(arguments.paths, arguments.site))
        claim_output(output, _PAGE)
        progress.show("drawing", 0.5)
        figures = list(make_figures(report))
        page = write_output(output, _PAGE, render(report, figures), figures)
    print(escape(answer(report)))
    if failed := len(report.sources.failed):
        print(f"runs that failed or did not finish: {failed}; the report lists them")
    print(escape(f"written to {page.resolve()}"))
