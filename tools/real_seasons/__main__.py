"""What forecasts as they were issued are worth: ``python tools/real_seasons ARCHIVES -o DIR``.

ARCHIVES is a directory with the previous runs of three services and the gauge's record, 2024-02-20
to 12-31 at Budva. On each roof of ``inputs.py``, from May to October, it runs on/off, and
``lookahead`` with a forecast of no rain, of each service, of the three as one ensemble, and a
perfect one. Each run is a file in DIR; the same command continues after an interruption. Writes
``DIR/real_seasons.csv``: all numbers, with intervals. ``doc/results/`` has a copy of it, from which
the documentation's tables and figure are made; the README has some of its numbers.

Assumed: evapotranspiration is the site file's monthly mean as a half sine over the day. Hours that
the gauge lacks are treated as dry. GFS's fifth day is left out.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from real_seasons.inputs import ROOFS, write_inputs
from real_seasons.runs import FORECASTS, Case, write
from real_seasons.table import Row, rows, write_rows


def main() -> None:
    """Make the runs that are not made yet, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", type=Path, metavar="ARCHIVES")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    archives, output = arguments.archives, arguments.output
    output.mkdir(parents=True, exist_ok=True)
    write_inputs(archives, output)
    cases = [Case(roof, forecast) for roof in ROOFS for forecast in FORECASTS]
    with ProcessPoolExecutor() as pool:
        for made in as_completed(
            pool.submit(write, case, archives, output)
            for case in cases if not case.file(output).exists()
        ):
            print(made.result(), file=sys.stderr, flush=True)
    table: list[Row] = []
    for roof in ROOFS:
        table += rows(roof, {
            forecast: json.loads(Case(roof, forecast).file(output).read_text(encoding="utf-8"))
            for forecast in FORECASTS
        })
    write_rows(table, output / "real_seasons.csv")


if __name__ == "__main__":
    main()
