"""What forecasts are worth from May to October: the rows of the file behind the README's figure."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from real_seasons.inputs import SEASON, Inputs
from real_seasons.runs import DRESSED, ISSUED, NO_RAIN, ONOFF_NAME, PERFECT, Case, build
from real_seasons.tables import Results, interval

from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.experiment.plan import recursion_plan

Row: TypeAlias = tuple[str, str, str, str, str, str]

COLUMNS = (
    "roof", "decided by", "mean deviation [mm]", "share of on/off's", "its low end", "its high end",
)
# The runs in the figure, by their labels.
SHOWN = {
    "on/off": (ONOFF_NAME, ISSUED),
    "lookahead, no forecast": (NO_RAIN, ISSUED),
    "with issued forecasts": ("three", ISSUED),
    "with dressed forecasts": ("three", DRESSED),
    "with perfect forecasts": (PERFECT, ISSUED),
}
LEAST = "least possible"
# Block length of the bound (ticks of a minute): with single ticks it takes longer than all runs.
_BLOCK = 10


def rows(roof: str, results: Results, inputs: Inputs, output: Path) -> Iterator[Row]:
    """Yield the rows of a roof: each run with its 95 % interval, and the least possible.

    The least possible lies between the bound, its low end, and the better of two plans that know
    all weather. It holds for the whole season, so it has no confidence interval.
    """
    season = {(case.source, case.form): run for case, run in results.items() if case.hour}
    onoff = season[SHOWN["on/off"]]
    total, mean = onoff["metrics"]["total_deviation_m3"], onoff["metrics"]["mean_deviation_mm"]
    for words, shown in SHOWN.items():
        share, low, high = interval(
            np.array(season[shown]["weeks"]), np.array(onoff["weeks"])
        )
        own = season[shown]["metrics"]["mean_deviation_mm"]
        yield roof, words, f"{own:.3f}", f"{share:.3f}", f"{low:.3f}", f"{high:.3f}"
    bound, plan = (value / total for value in _least(roof, inputs, output))
    yield roof, LEAST, f"{plan * mean:.3f}", f"{plan:.3f}", f"{bound:.3f}", f"{plan:.3f}"


def _least(roof: str, inputs: Inputs, output: Path) -> tuple[float, float]:
    """Return the bound of the season's total deviation (m3), and the better plan's deviation."""
    case = Case(roof, SEASON, PERFECT, trusts=False)
    file = case.file(output).with_name("least_possible.json")
    if not file.exists():
        run = build(case, inputs)
        bound, recursion = clairvoyant_bound(run, block=_BLOCK), recursion_plan(run)
        file.write_text(json.dumps({
            "bound_m3": bound.bound_m3, "plan_m3": min(bound.plan_m3, recursion.total_m3),
        }), encoding="utf-8")
    least = json.loads(file.read_text(encoding="utf-8"))
    return least["bound_m3"], least["plan_m3"]


def write(lines: list[Row], file: Path) -> None:
    """Write the rows of both roofs."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        csv.writer(stream, lineterminator="\n").writerows([COLUMNS, *lines])
