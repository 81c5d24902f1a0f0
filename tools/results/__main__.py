"""Run the studies behind ``doc/results.md``, and keep what its tables and figures need.

``python tools/results`` runs those that take minutes, ``python tools/results NAME ...`` the named
ones. Each study goes to ``studies/NAME``, where a finished one is not run again, and is reduced to
``doc/results/NAME.csv``; ``python doc/generate.py`` makes the page's table and figure of that.

A table of runs has a row for each run, in all digits: what differs between the runs, and their
deviation. A table of seasons has a row for each controller, over all years and seeds. The studies
of seasons take hours, and need the records of ``doc/running/seasons.md`` in ``--weather DIR``.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

from paths import CHECKOUT

from greenroof_ros.model.site import read_site
from greenroof_ros.recording.results_table import differing, row_parameters
from greenroof_ros.report.intervals import Deviations, compare

Rows = list[dict[str, str]]

_CONFIG = CHECKOUT / "config" / "studies"
_HERE = Path(__file__).resolve().parent
# Of the initial state, which its name says.
_VOLUMES = ("cistern_m3", "roof_m3")
OUTCOMES = ("total_deviation_m3", "mean_deviation_mm", "bound_m3")


def inputs(rows: Rows) -> list[str]:
    """Return the columns that tell runs apart, before the columns of their outcomes.

    A parameter is among them where it differs between the runs of a controller.
    """
    given = list(rows[0])[1 : list(rows[0]).index("status")]
    by_controller: dict[str, Rows] = defaultdict(list)
    for row in rows:
        by_controller[row["controller"]].append(row)
    parameters = {name for own in by_controller.values() for name in differing(own)}
    known = parameters | {name for name in differing(rows) if not row_parameters({name: ""})}
    return [name for name in given if name in known and name not in _VOLUMES]


def runs(study: Path) -> Rows:
    """Return a row for each run: what differs between them, and their deviation."""
    rows = read(study / "results.csv")
    columns = [*inputs(rows), *(name for name in OUTCOMES if rows[0][name])]
    return [{name: row[name] for name in columns} for row in rows]


def seasons(study: Path) -> Rows:
    """Return a row for each controller and roof, over the years and seeds of its seasons.

    The mean deviation is of all years (mm); its ratio to that of the first on/off on the same roof
    has a 95 % interval. Beside it are the number of years with less than on/off, and the ratio to
    the least possible where the study has it.
    """
    rows = read(study / "results.csv")
    columns = [
        name for name in inputs(rows) if name not in ("weather", "start", "forecast_seed")
    ]
    cases: dict[tuple[str, ...], Rows] = defaultdict(list)
    for row in rows:
        cases[tuple(row[name] for name in columns)].append(row)
    onoff = {}
    for own in cases.values():
        if own[0]["controller"] == "onoff":
            onoff.setdefault(own[0]["site"], _by_year(own))
    table = []
    for case, own in cases.items():
        against = compare(_by_year(own), onoff[own[0]["site"]])
        assert against is not None, "two years, in which on/off has some deviation"
        mean = np.mean([float(row["mean_deviation_mm"]) for row in own])
        names = ("mean_deviation_mm", "over_onoff", "low", "high", "better", "years")
        outcomes = [mean, *against.mean, against.better, against.years]
        if own[0]["bound_m3"]:
            names = (*names, "over_least")
            total, least = (
                np.mean([float(row[name]) for row in own])
                for name in ("total_deviation_m3", "bound_m3")
            )
            outcomes.append(total / least)
        table.append({
            **dict(zip(columns, case, strict=True)),
            **dict(zip(names, map(str, outcomes), strict=True)),
        })
    return table


def _by_year(rows: Rows) -> Deviations:
    """Return the deviations of one controller, year by year."""
    deviations = Deviations()
    for year in dict.fromkeys(int(row["start"][:4]) for row in rows):
        own = [row for row in rows if int(row["start"][:4]) == year]
        deviations.totals[year] = np.array([float(row["total_deviation_m3"]) for row in own])
        deviations.weeks[year] = np.array([
            [float(week) for week in row["weekly_deviation_m3"].split()] for row in own
        ])
    return deviations


def sizes(study: Path) -> Rows:
    """Return the mains water saved in a season (m3) for each size, as a mean over the years."""
    saved: dict[tuple[str, float, float], list[float]] = defaultdict(list)
    for row in read(study / "results.csv"):
        site = read_site(study / "configuration" / row["site"])
        size = row["initial"], site.a2, site.a1 * site.z_o
        saved[size].append(float(row["saved_m3"]))
    return [
        {"initial": initial, "green_roof_m2": str(roof), "cistern_m3": str(cistern),
         "saved_m3": str(np.mean(values))}
        for (initial, roof, cistern), values in saved.items()
    ]


TABLES: dict[str, tuple[Path, Callable[[Path], Rows]]] = {
    "paper": (_CONFIG / "paper.yaml", runs),
    "methods": (_CONFIG / "methods.yaml", runs),
    "windows": (_HERE / "windows.yaml", runs),
    "forecasts": (_CONFIG / "forecasts.yaml", runs),
    "useless_forecasts": (_CONFIG / "useless_forecasts.yaml", runs),
    "robustness": (_CONFIG / "robustness.yaml", runs),
    "month": (_HERE / "month.yaml", runs),
    "lookahead": (_CONFIG / "lookahead.yaml", seasons),
    "seasons": (_CONFIG / "seasons.yaml", seasons),
    "horizons": (_CONFIG / "horizons.yaml", seasons),
    "skills": (_CONFIG / "skills.yaml", seasons),
    "sizing": (_CONFIG / "sizing.yaml", sizes),
}
OF_YEARS = ("lookahead", "seasons", "horizons", "skills", "sizing")


def read(path: Path) -> Rows:
    """Return the rows of a table."""
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def write(path: Path, rows: Rows) -> None:
    """Write a table; a column that only some rows have is empty in the others."""
    columns = dict.fromkeys(name for row in rows for name in row)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def make(name: str, weather: Iterable[str]) -> None:
    """Run a study, or the rest of it, and write its table."""
    grid, reduce = TABLES[name]
    study = Path("studies") / name
    subprocess.run(
        [
            sys.executable, "-m", "greenroof_ros", "study", str(grid), "--no-trajectories",
            "--output", str(study), *weather,
        ],
        check=True,
    )
    path = CHECKOUT / "doc" / "results" / f"{name}.csv"
    write(path, reduce(study))
    print(f"written to {path}")


def main() -> None:
    """Make the tables that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "names", nargs="*", metavar="NAME", choices=[*TABLES, []],
        help=f"of a table: {', '.join(TABLES)} (default: all but {', '.join(OF_YEARS)})",
    )
    parser.add_argument("--weather", metavar="DIR", help="the records of eleven years")
    arguments = parser.parse_args()
    weather = [] if arguments.weather is None else ["--weather", arguments.weather]
    try:
        for name in arguments.names or [name for name in TABLES if name not in OF_YEARS]:
            make(name, weather)
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the study has said why


if __name__ == "__main__":
    main()
