"""What forecasts as they were issued are worth: ``python test/real_seasons ARCHIVES -o DIR``.

ARCHIVES is a directory with the previous runs of three services and the gauge's record beside them,
2024-02-20 to 12-31 at Budva. On a measured roof and on the paper's, both with mains, it runs
on/off, and ``lookahead`` with a forecast of no rain; in May to October also of each service, of the
three as one ensemble, of a placebo, and a perfect one: as issued, with trust that is learned, and
dressed by the same record without the days around each issue. Each run is a file in DIR; the same
command goes on where it was. Prints tables in Markdown, the first of what dressing does to sums.

Assumed: evapotranspiration is the site file's monthly mean as a half sine over the day. Hours that
the gauge lacks count as dry. GFS's fifth day is left out. The placebo is GEM's issues of 35 days
later, and at the end those of the first weeks: as wet, and without skill.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent.parent)]

from real_seasons import dressing  # noqa: E402
from real_seasons.inputs import SEASON, YEAR, Inputs, Period  # noqa: E402
from real_seasons.runs import (  # noqa: E402
    DRESSED,
    NO_RAIN,
    ONOFF_NAME,
    PERFECT,
    SOURCES,
    Case,
    write,
)
from real_seasons.tables import Results, of_owner, of_period, trust  # noqa: E402

RUNS = (
    ("measured", YEAR), ("measured, target 39 mm", YEAR), ("measured", SEASON), ("paper", SEASON),
)


def cases(roof: str, period: Period) -> Iterator[Case]:
    """Yield the runs of a period on a roof."""
    yield Case(roof, period, ONOFF_NAME)
    yield Case(roof, period, NO_RAIN, trusts=False)
    if period is YEAR:
        return
    yield Case(roof, period, PERFECT, trusts=False)
    for source in SOURCES:
        yield Case(roof, period, source)
        yield Case(roof, period, source, DRESSED)
    yield Case(roof, period, "placebo", trusts=False)
    yield Case(roof, period, "placebo", DRESSED, trusts=False)


def main() -> None:
    """Make the runs, and print what they found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("archives", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        inputs = Inputs(arguments.archives, Path(scratch))
        print(*dressing.table(inputs), sep="\n", flush=True)
        for roof, period in RUNS:
            found: Results = {}
            for case in cases(roof, period):
                file = case.file(arguments.output)
                if not file.exists():
                    write(case, inputs, file)
                    print(file, file=sys.stderr, flush=True)
                found[case] = json.loads(file.read_text(encoding="utf-8"))
            print(f"\n## {roof}, {period.words}")
            for lines in (of_period(found), trust(found), of_owner(found)):
                print("", *lines, sep="\n", flush=True)


if __name__ == "__main__":
    main()
