"""Panels of any values: none, one, constant, missing or not finite; and what is drawn of many."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from inputs import NAMES, START, figures_of, simulate, study_of
from paper import PAPER_SITE

from greenroof_ros.analysis.calibration.page import draw_quantity
from greenroof_ros.analysis.calibration.step_record import StepRecord
from greenroof_ros.analysis.figures import Figure, value_scale
from greenroof_ros.analysis.report.figures import draw_events
from greenroof_ros.analysis.report.groups import TOTAL
from greenroof_ros.analysis.report.page import payload
from greenroof_ros.analysis.report.trajectories import (
    MAX_POINTS,
    figures_over_time,
    overlay_simulations,
    select_curves,
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
def test_figures_of_any_values(tmp_path: Path, values: list[float]) -> None:
    """Every figure is drawn: of a run in which it neither rained nor pumped, for one."""
    length = len(values)
    trajectory = Trajectory(start=START, **{
        **{name: np.array(values) for name in NAMES}, "time": np.arange(length, dtype=float),
    })
    run = select_curves(PAPER_SITE, trajectory)
    figures = figures_over_time({"mpc": run}, "1", "")
    assert [figure.name for figure in figures] == ["water-1", "flows-1"]
    unknown, known = np.array(values), np.zeros(length)
    record = StepRecord(Path("twin.csv"), START, 3600.0, *[known] * 3, unknown, unknown)
    half = np.arange(length) < length // 2
    figures += [
        draw_quantity(quantity, record, halves, known) for quantity in record.measured
        for later in (~half, half & ~half) for halves in [{"fit": half, "validation": later}]
    ]
    for figure in figures:
        width, height = size(tmp_path, figure)
        assert width > 400 and height > 200
    panels = overlay_simulations({"mpc": (PAPER_SITE, trajectory)}).vconcat
    flows = any(value > 0 for value in values[:-1])  # the last one never held
    assert len(panels) == 4 + flows  # what reaches the sewer


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES.keys())
def test_events_of_any_values(tmp_path: Path, values: list[float]) -> None:
    """Also depth or reductions alone may be all the same, and a reduction far below 0."""
    event = dict.fromkeys(("rain_mm", "volume_reduction", "peak_reduction"), 1.0)
    for name in event:
        rows = [{**event, "start": START.isoformat(), name: value} for value in values]
        for own in ({"a": rows}, {"a": rows, "b": [{**row, name: -30.0} for row in rows]}, {}):
            figure = draw_events(own, "events-1", "")
            width, height = size(tmp_path, figure)
            assert width > 800 and height > 200
            for panel in figure.panels:
                low, high = panel.chart.to_dict()["encoding"]["y"]["scale"]["domain"]
                assert -1.0 <= low <= 0.0 and high == 1.0
            payload([figure])


@pytest.mark.parametrize("value", ["", "0.0"])
def test_results_that_are_missing_or_0(tmp_path: Path, value: str) -> None:
    """All metrics but the deviation; the total is 0 for both runs."""
    row = simulate("onoff", "0.5", "low-low", "0.01").row
    results = {metric.name: value for metric in METRICS}
    rows = [
        {**row, **results, TOTAL: 0.0, "case": case, "bound_m3": value} for case in ("a", "b")
    ]
    figures = figures_of(study_of(tmp_path / "study", *rows))
    assert list(figures) == ["deviation-1"]
    for figure in figures.values():
        size(tmp_path, figure)


def test_a_large_value_flattens_no_panel() -> None:
    """The axis is logarithmic if values differ by more than five times, and none is 0."""
    for values, kind in (
        ([7152.0, 9582.0, None], "linear"), ([7152.0, 9582.0, 500_000.0], "log"),
        ([0.0, 1.0, 500.0], "linear"), ([], "linear"),
    ):
        assert value_scale(values).to_dict()["type"] == kind


def test_thinning_keeps_extremes() -> None:
    """A peak of one sample among 43,200 is drawn, and so are both ends."""
    values = np.sin(np.arange(43_200) / 1000)
    values[12_345], values[20_001] = 7.0, -7.0
    index = select_samples(values)
    assert len(index) <= MAX_POINTS + 2
    assert {0, 12_345, 20_001, 43_199} <= set(index.tolist())
