"""Panels of any values: constant, missing or not finite; and what is drawn of many."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from inputs import NAMES, START
from paper import PAPER_SITE

from greenroof_ros.analysis.figures import Figure
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


def test_thinning_keeps_extremes() -> None:
    """A peak of one sample among 43,200 is drawn, and so are both ends; of few, all are."""
    values = np.sin(np.arange(43_200) / 1000)
    values[12_345], values[20_001] = 7.0, -7.0
    index = select_samples(values)
    assert len(index) <= MAX_POINTS + 2
    assert {0, 12_345, 20_001, 43_199} <= set(index.tolist())
    assert select_samples(np.arange(499.0)).tolist() == list(range(499))
