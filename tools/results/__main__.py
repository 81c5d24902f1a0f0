"""Run the studies behind ``doc/results.md``, and keep what its tables and figures need.

``python tools/results`` runs the studies that take minutes, ``python tools/results NAME ...`` the
named ones. Each study goes to ``studies/NAME``, where a finished one is not repeated, and is
reduced to ``doc/results/NAME.csv``; ``python doc/generate.py`` makes the page's table and figure.

A table of runs has a row for each run, in all digits: what differs between the runs, and their
deviation. A table of seeds or seasons has a row for each controller, over all of them. The studies
of seasons take hours, and need the records of ``doc/howto/choose-target-and-controller.md`` in
``--weather DIR``.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

from paths import CHECKOUT
from results.reduction import Rows, runs, seasons, seeds, sizes, write

_CONFIG = CHECKOUT / "config" / "studies"
_HERE = Path(__file__).resolve().parent

TABLES: dict[str, tuple[Path, Callable[[Path], Rows]]] = {
    "methods": (_CONFIG / "methods.yaml", runs),
    "windows": (_HERE / "windows.yaml", runs),
    "forecasts": (_CONFIG / "forecasts.yaml", seeds),
    "useless_forecasts": (_CONFIG / "useless_forecasts.yaml", runs),
    "robustness": (_CONFIG / "robustness.yaml", runs),
    "month": (_HERE / "month.yaml", runs),
    "seasons": (_CONFIG / "seasons.yaml", seasons),
    "horizons": (_CONFIG / "horizons.yaml", seasons),
    "sizing": (_CONFIG / "sizing.yaml", sizes),
}
OF_YEARS = ("seasons", "horizons", "sizing")


def make(name: str, weather: Sequence[str]) -> None:
    """Run a study, or what remains of it, and write its table."""
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
        help=f"tables to make: {', '.join(TABLES)} (default: all but {', '.join(OF_YEARS)})",
    )
    parser.add_argument("--weather", metavar="DIR", help="directory of the records of eleven years")
    arguments = parser.parse_args()
    weather = [] if arguments.weather is None else ["--weather", arguments.weather]
    try:
        for name in arguments.names or [name for name in TABLES if name not in OF_YEARS]:
            make(name, weather)
    except subprocess.CalledProcessError as error:
        sys.exit(error.returncode)  # the study has printed why


if __name__ == "__main__":
    main()
