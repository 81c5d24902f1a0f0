"""Checks of a record before its fit, and of the fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from refusals import refusal
from twins import a_record

from greenroof_ros.analysis.calibration.checks import check_fit, check_record
from greenroof_ros.analysis.calibration.scores import FitScores, score


def test_too_little_for_a_fit() -> None:
    """Less than 100 values, or than 20 mm of water, as of rain in metres."""
    rain = np.where(np.arange(3000) % 100 == 0, 1.0, 0.0)
    nothing = np.full(3000, np.nan)
    empty = a_record(rain, level=nothing)
    refusal(check_record, empty, match="level: has 0 values; a fit needs")
    wet = a_record(rain / 1000, level=np.linspace(0, 0.02, 3000))
    refusal(check_record, wet, match="rain: is 0.03 mm in total, .* Is the unit of the")


FILE = Path("roof.csv")
MEASURED = np.where(np.arange(240) % 60 < 6, 1.0, 0.0)
GOOD, HALF_MORE = 0.9 * MEASURED, 1.6 * MEASURED
# Falls where the data rise: the mean's volume, and NSE 1 - 4 = -3 of hours and of days.
OPPOSITE = 2 * MEASURED.mean() - MEASURED


def row(part: str, simulated: np.ndarray, step_s: float = 3600.0) -> FitScores:
    seconds = (step_s * np.arange(len(MEASURED))).astype(np.int64)
    return score("runoff", part, simulated, MEASURED, seconds, step_s)


def test_a_fit_is_judged_by_the_half_that_it_has_not_seen() -> None:
    """There is no fit if it is worse than the mean everywhere; daily sums are judged by days.

    A level that changes judges the fit if nothing runs off in the second half.
    """
    for fitted, judged, step_s, refuses, text in (
        (OPPOSITE, OPPOSITE, 3600.0, True, "runoff in fit -3.00, runoff in validation -3.00"),
        (OPPOSITE, OPPOSITE, 86400.0, True, "runoff in fit -3.00"),
        (GOOD, OPPOSITE, 3600.0, False, "the NSE of runoff is -3.00: do not use this fit"),
        (GOOD, HALF_MORE, 3600.0, False, "the volume of runoff is off by +60 %"),
    ):
        rows = [row("fit", fitted, step_s), row("validation", judged, step_s)]
        if refuses:
            assert text in refusal(check_fit, rows, FILE)
        else:
            (warning,) = check_fit(rows, FILE)
            assert text in warning
    assert check_fit([row("fit", OPPOSITE), row("validation", GOOD)], FILE) == []
    nothing = np.zeros(240)
    dry = score("runoff", "validation", nothing, nothing, np.arange(240) * 3600, 3600.0)
    level = row("validation", GOOD)._replace(quantity="level")
    assert check_fit([row("fit", GOOD), dry, level], FILE) == []
    refusal(check_fit, [row("fit", OPPOSITE), dry], FILE, match="roof.csv: no roof fits")
