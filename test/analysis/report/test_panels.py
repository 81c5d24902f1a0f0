"""Panels of any values: constant, missing or not finite; and what is drawn of many."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from inputs import NAMES, START
from paper import PAPER_SITE

from greenroof_ros.analysis.figures import COLOURS, Figure
from greenroof_ros.analysis.report.figures import (
    MAX_POINTS,
    draw_over_time,
    overlay_simulations,
    select_samples,
)
from greenroof_ros.results.trajectory import Trajectory

VALUES: dict[str, list[float]] = {
    "zeros": [0.0] * 3, "constant": [2.0] * 3,
    "some missing": [1.0, math.nan, math.inf], "all missing": [math.nan] * 3,
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES.keys())
def test_runs_of_any_values(tmp_path: Path, values: list[float]) -> None:
    """Every figure is drawn: of a run in which it neither rained nor pumped, for one."""
    trajectory = Trajectory(start=START, **{
        **{name: np.array(values) for name in NAMES}, "time": np.arange(float(len(values))),
    })
    runs = {"mpc": (PAPER_SITE, trajectory)}
    Figure("time", "", "", tuple(draw_over_time(runs)), 2).save(tmp_path)
    assert (tmp_path / "time.svg").read_text().startswith("<svg")
    flows = any(value > 0 for value in values[:-1])  # the last one never held
    # What reaches the sewer, and the opening of the valve.
    assert len(overlay_simulations(runs).vconcat) == 4 + 2 * flows


@pytest.mark.parametrize("names", [["onoff"], ["onoff", "mpc"]])
def test_every_run_has_a_visible_line(tmp_path: Path, names: list[str]) -> None:
    """Each line has a colour in the drawing, also that of a single run, and none is shared."""
    trajectory = Trajectory(start=START, **{
        **{name: np.array([1.0, 2.0, 3.0]) for name in NAMES}, "time": np.arange(3.0),
    })
    runs = dict.fromkeys(names, (PAPER_SITE, trajectory))
    Figure("time", "", "", tuple(draw_over_time(runs)), 2).save(tmp_path)
    overlay_simulations(runs).save(tmp_path / "chart.svg")
    for file in tmp_path.glob("*.svg"):
        groups = [each for each in ElementTree.parse(file).iter() if (
            each.get("class", "").startswith("mark-line")
        )]
        _, *strokes = (path.get("stroke") for group in groups for path in group)  # first the rain's
        # In roof, cistern, pump, sewer and valve.
        assert Counter(strokes) == dict.fromkeys(COLOURS[: len(names)], 5), file


def test_thinning_keeps_extremes() -> None:
    """A peak of one sample among 43,200 is drawn, and so are both ends; of few, all are."""
    values = np.sin(np.arange(43_200) / 1000)
    values[12_345], values[20_001] = 7.0, -7.0
    index = select_samples(values)
    assert len(index) <= MAX_POINTS + 2
    assert {0, 12_345, 20_001, 43_199} <= set(index.tolist())
    assert select_samples(np.arange(499.0)).tolist() == list(range(499))
