"""Panels of any values: none, one, constant, missing or not finite; and what is drawn of many."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from inputs import NAMES, START, figures_of, simulate, study_of
from paper import PAPER_SITE

from greenroof_ros.analysis.figures import Figure
from greenroof_ros.analysis.report.cases import TOTAL
from greenroof_ros.analysis.report.trajectories import (
    MAX_POINTS,
    draw_over_time,
    overlay_simulations,
    select_samples,
)
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.results.trajectory import Trajectory


def size(directory: Path, figure: Figure) -> tuple[int, int]:
    """Draw a figure to its files, and return width and height of the picture (px)."""
    figure.save(directory)
    assert (directory / f"{figure.name}.svg").read_text().startswith("<svg")
    picture = (directory / f"{figure.name}.png").read_bytes()
    width, height = struct.unpack(">II", picture[16:24])
    return width // 2, height // 2


VALUES: dict[str, list[float]] = {
    "none": [], "one": [1.0], "zeros": [0.0] * 3, "constant": [2.0] * 3,
    "some missing": [1.0, math.nan, math.inf], "all missing": [math.nan] * 3,
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES.keys())
def test_runs_of_any_values(tmp_path: Path, values: list[float]) -> None:
    """Every figure is drawn: of a run in which it neither rained nor pumped, for one."""
    length = len(values)
    trajectory = Trajectory(start=START, **{
        **{name: np.array(values) for name in NAMES}, "time": np.arange(length, dtype=float),
    })
    runs = {"mpc": (PAPER_SITE, trajectory)}
    width, height = size(tmp_path, Figure("time-1", "", "", tuple(draw_over_time(runs)), 2))
    assert width > 400 and height > 200
    flows = any(value > 0 for value in values[:-1])  # the last one never held
    assert len(overlay_simulations(runs).vconcat) == 4 + flows  # what reaches the sewer


@pytest.mark.parametrize("value", ["", "0.0"])
def test_results_that_are_missing_or_0(tmp_path: Path, value: str) -> None:
    """All metrics but the deviation; the total is 0 for both runs."""
    row = simulate("onoff", "0.5", "low-low", "0.01").row
    results = {metric.name: value for metric in METRICS}
    rows = [
        {**row, **results, TOTAL: 0.0, "case": case, "bound_m3": value} for case in ("a", "b")
    ]
    figures = figures_of(study_of(tmp_path / "study", *rows))
    assert list(figures) == ["comparison"]
    size(tmp_path, figures["comparison"])


def test_thinning_keeps_extremes() -> None:
    """A peak of one sample among 43,200 is drawn, and so are both ends."""
    values = np.sin(np.arange(43_200) / 1000)
    values[12_345], values[20_001] = 7.0, -7.0
    index = select_samples(values)
    assert len(index) <= MAX_POINTS + 2
    assert {0, 12_345, 20_001, 43_199} <= set(index.tolist())
