"""What forecasts as they were issued are worth: ``python tools/real_seasons ARCHIVES -o DIR``.

ARCHIVES is a directory with the previous runs of three services and the gauge's record, 2024-02-20
to 12-31 at Budva. On a measured roof and on the paper's, both with mains, it runs on/off, and
``lookahead`` with a forecast of no rain, of each service, of the three as one ensemble, of a
placebo, and a perfect one: as issued, with trust that is learned, and dressed. Each run is a file
in DIR; the same command continues after an interruption. Writes ``DIR/real_seasons.csv``: all
numbers, with intervals. ``doc/results/`` has a copy of it, from which the documentation's tables
and the README's figure are made.

- **dressed**: by the same record, without the days around each issue.
- **by the other half**: the period's blocks of four weeks are divided by their rain into a wetter
  and a drier half. Each is dressed by the rain of the other, and judged by itself. No storm is in
  both, because no issue within the length of a member and five days of another dresses it.
- **with its own numbers**: the half that dresses also chooses the numbers of dressing
  (``own_numbers.py``).
- **scaled**: the rain of GFS, which is too dry, times one factor in each half: the gauge's rain
  over the forecast's, in the other half or in the half itself.
- **used ideally**: an ensemble that knows as much as a service, and is reliable (``ideal.py``).
- **the hour as forecast**: in the present hour only the rain in this minute is known.

Assumed: evapotranspiration is the site file's monthly mean as a half sine over the day. Hours that
the gauge lacks count as dry. GFS's fifth day is left out. The placebo is GEM's issues from 35 days
later, and at the end from the first weeks: as wet as GEM, but without skill.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from real_seasons.ideal import DRAWS
from real_seasons.inputs import AUTUMN, ROOFS, SEASON, SERVICES, YEAR, Inputs, Period
from real_seasons.least import least_possible
from real_seasons.runs import (
    CROSSED,
    DRESSED,
    IDEAL,
    NESTED,
    NO_RAIN,
    ONOFF_NAME,
    PERFECT,
    SCALED,
    SCALED_BY_ITSELF,
    SOURCES,
    Case,
    write,
)
from real_seasons.tables import Results, Row, rows
from real_seasons.tables import write as write_rows

PERIODS = {"year": YEAR, "season": SEASON, "autumn": AUTUMN}


def cases(roof: str, period: Period) -> Iterator[Case]:
    """Yield the runs of a period on a roof, the most useful first."""
    if period is AUTUMN:
        if roof == "measured":
            yield Case(roof, period, "three")
            yield Case(roof, period, "three", hour=False)
        return
    yield Case(roof, period, ONOFF_NAME)
    yield Case(roof, period, NO_RAIN, trusts=False)
    if roof == "measured, target 39 mm":
        yield Case(roof, period, "three", DRESSED)
        yield Case(roof, period, "three")
        yield Case(roof, period, PERFECT, trusts=False)
        return
    for source in SOURCES:
        yield Case(roof, period, source)
        if period is YEAR:
            yield Case(roof, period, source, CROSSED)
            if roof == "measured" and source != "placebo":
                yield Case(roof, period, source, NESTED)
        if source == SOURCES[0]:
            yield Case(roof, period, PERFECT, trusts=False)
    for source in SOURCES:
        yield Case(roof, period, source, DRESSED)
    if period is SEASON and roof == "measured":
        for form in (SCALED, SCALED_BY_ITSELF):
            yield Case(roof, period, "GFS", form)
        for source in SERVICES:
            for draw in DRAWS:
                yield Case(roof, period, source, IDEAL, draw=draw)
    if period is SEASON:
        yield Case(roof, period, "placebo", trusts=False)
        yield Case(roof, period, "placebo", DRESSED, trusts=False)


def main() -> None:
    """Make the runs, and write and draw their results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--periods", nargs="+", choices=list(PERIODS), default=list(PERIODS))
    parser.add_argument("--roofs", nargs="+", choices=list(ROOFS), default=list(ROOFS))
    parser.add_argument("--tables", action="store_true", help="use existing runs only")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        inputs = Inputs(arguments.archives, Path(scratch))
        made: list[Row] = []
        for roof, name in itertools.product(arguments.roofs, arguments.periods):
            period = PERIODS[name]
            results: Results = {}
            for case in cases(roof, period):
                file = case.file(arguments.output)
                if not file.exists():
                    if arguments.tables:
                        continue
                    write(case, inputs, file)
                    print(file, file=sys.stderr, flush=True)
                results[case] = json.loads(file.read_text(encoding="utf-8"))
            made += rows(results, inputs, roof, period)
            if "," not in roof and Case(roof, SEASON, ONOFF_NAME) in results:
                made += least_possible(roof, results, inputs, arguments.output)
    write_rows(made, arguments.output / "real_seasons.csv")


if __name__ == "__main__":
    main()
