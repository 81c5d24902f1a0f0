"""Evaluate and plot runs in a report: ``greenroof report PATH [PATH ...]``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command
from greenroof_ros.base.errors import ConfigurationError, require_extra
from greenroof_ros.base.files import add_path_to_errors
from greenroof_ros.base.progress import ProgressBar
from greenroof_ros.base.text import escape

# A report's directory contains this file and figures/.
_PAGE = "report.html"

_DESCRIPTION = """\
Evaluate and plot runs on a single page that can be viewed in any browser. The page contains figures
of deviation, levels and flows, and tables of deviation, water balance, energy and pump starts.
"""
_EPILOG = """\
The output consists of report.html, and all figures as SVG and PNG in figures/. A bag must contain
/cistern/level, /roof/level, /pump/command and /pump/flow, possibly in a namespace. If any other
topic is missing, its values are taken to be 0, and the report notes this. The pumps' efficiency is
taken from pump_efficiency in the site file.

examples:
  greenroof report studies/paper                   a study
  greenroof report runs/a runs/b --output both     runs or simulations, overlaid
  greenroof report bag --site my_site.yaml         a bag of a real site
"""


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(prog="greenroof report", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument(
        "paths", type=Path, nargs="+", metavar="PATH",
        help="directory of a study or a run, a bag, or an .mcap file",
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR",
        help="write the report to this directory, which may be new or empty, or may contain an "
        "earlier report, which is replaced. A directory with other files is rejected (default: "
        "report in the first PATH)",
    )
    parser.add_argument(
        "--site", type=Path, metavar="FILE",
        help="site file of the bags (default: configuration/site.yaml next to each bag, or the "
             "paper's site)",
    )
    return parser


def _former_figures(directory: Path, own: Callable[[str], bool]) -> list[Path]:
    """Return the figures of an earlier report that the new report replaces.

    Args:
        directory: directory of the new report.
        own: function that tells whether a file name in ``figures/`` is that of a report figure.

    Raises:
        ConfigurationError: if the directory contains other files.
    """
    figures = directory / "figures"
    others = [file for file in directory.glob("*") if file not in (figures, directory / _PAGE)]
    others += [file for file in figures.glob("*") if not (file.is_file() and own(file.name))]
    if others:
        raise ConfigurationError(
            f"contains {min(others).relative_to(directory)}, which is not part of a report; "
            "choose another directory", key="--output", value=str(directory),
        )
    return list(figures.glob("*"))


@command
def main() -> None:
    """Make the report that the command line describes."""
    arguments = make_parser().parse_args()
    with require_extra("study"):
        from greenroof_ros.analysis.report import figures, page
        from greenroof_ros.analysis.report.groups import Report
        from greenroof_ros.analysis.report.sources import find_runs
    output: Path = arguments.output or arguments.paths[0] / "report"
    former = _former_figures(output, figures.is_figure)
    with ProgressBar() as progress:
        report = Report(find_runs(arguments.paths, arguments.site, progress.show))
        made = list(figures.make_figures(report))
        (output / "figures").mkdir(parents=True, exist_ok=True)
        for number, figure in enumerate(made):
            progress.show(f"drawing {figure.name}", number / len(made))
            figure.save(output / "figures")
    with add_path_to_errors(output / _PAGE):
        (output / _PAGE).write_text(page.render(report, made), encoding="utf-8")
    names = {figure.name for figure in made}
    for file in former:
        if file.stem not in names:
            file.unlink()
    for run in report.runs:
        if run.row.get("ended"):
            ended = f"{run.name} {run.row['ended']}"
            print(escape(f"{ended}; all results cover only the recorded part"))
    if report.failed:
        print(f"runs that failed or were not started: {len(report.failed)}; the report lists them")
    print(escape(f"written to {output.resolve() / _PAGE}"))
