"""The least deviation that any controller could have from May to October."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from real_seasons.inputs import SEASON, Inputs
from real_seasons.runs import ONOFF_NAME, PERFECT, Case, build
from real_seasons.tables import ALL, DEVIATION, OVER_ONOFF, Results, Row

from greenroof_ros.experiment.clairvoyant import clairvoyant_bound
from greenroof_ros.experiment.plan import recursion_plan

# Block length of the bound (ticks of a minute): with single ticks it takes longer than all runs.
_BLOCK = 10


def least_possible(roof: str, results: Results, inputs: Inputs, output: Path) -> Iterator[Row]:
    """Yield the least possible deviation, over on/off's and in mm.

    It lies between the bound, its low end, and the better of two plans that know all weather. It
    holds for the whole season, so it has no confidence interval.
    """
    onoff = results[Case(roof, SEASON, ONOFF_NAME)]["metrics"]
    bound, plan = (value / onoff["total_deviation_m3"] for value in _least(roof, inputs, output))
    for measure, unit in ((OVER_ONOFF, 1.0), (DEVIATION, onoff["mean_deviation_mm"])):
        yield Row(
            roof, SEASON.words, ALL, "least possible", "", measure, plan * unit, bound * unit,
            plan * unit,
        )


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
