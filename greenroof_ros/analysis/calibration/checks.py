"""Checks before the fit, that there is enough to fit, and of the fit by what it has not seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from greenroof_ros.analysis.calibration.scores import FitScores
from greenroof_ros.analysis.calibration.step_record import HOUR_S, StepRecord
from greenroof_ros.base.errors import ConfigurationError

# The minimum for a fit: number of values in every column, and water (mm).
_MIN_VALUES, _MIN_WATER = 100, 20.0


def check_record(record: StepRecord) -> None:
    """Reject a record that is too short for a fit.

    Args:
        record: the measurements in the steps used for the fit or the validation.

    Raises:
        ConfigurationError: if the record has too few values, or too little water.
    """
    for column, values in {"rain": record.rain, **record.measured}.items():
        there = int(np.count_nonzero(~np.isnan(values)))
        if there < _MIN_VALUES:
            raise ConfigurationError(
                f"has {there} values; a fit needs at least {_MIN_VALUES}", file=record.source,
                key=column,
            )
    water = float(record.water.sum())
    if water < _MIN_WATER:
        raise ConfigurationError(
            f"is {water:.3g} mm in total, including pumped water, but a fit needs at least "
            f"{_MIN_WATER:g} mm. Is the unit of the column right?", file=record.source, key="rain",
        )


# If the volume of runoff is wrong by more than this share, the fit is poor.
_VOLUME_OFF = 0.5


def check_fit(scores: Sequence[FitScores], source: Path) -> list[str]:
    """Return warnings about a fit.

    There is a warning if, in the validation, the daily NSE is below 0 (or the NSE of hours or
    longer steps, if there are too few days), or if the volume of runoff is off by more than half.

    Args:
        scores: scores of every series, for the fit and for the validation.
        source: path of the record.

    Raises:
        ConfigurationError: if every NSE is below 0, for hours (or longer steps) and for days, in
            the fit and in the validation, and for every series.
    """
    nses = [
        (row, [nse for span_s, nse in row.nse.items() if span_s >= HOUR_S and not math.isnan(nse)])
        for row in scores
    ]
    advice = "Check the units, the clocks, the sensors, and the site's a2 and z_soil."
    if all(nse < 0 for _, of_row in nses for nse in of_row):
        best = ", ".join(
            f"{row.quantity} in {row.part} {max(of_row):.2f}" for row, of_row in nses if of_row
        )
        raise ConfigurationError(
            f"no roof fits this record: the best NSE is {best}, whereas the mean of the "
            f"measurements alone would achieve an NSE of 0. {advice}", file=source,
        )
    why = [
        f"the NSE of {row.quantity} is {of_row[-1]:.2f}" for row, of_row in nses
        if row.part == "validation" and of_row and of_row[-1] < 0
    ] + [
        f"the volume of runoff is off by {100 * row.volume_error:+.0f} %" for row, _ in nses
        if (row.part, row.quantity) == ("validation", "runoff")
        and abs(row.volume_error) > _VOLUME_OFF
    ]
    return [
        f"in the half that was not used for the fit, {' and '.join(why)}: do not use this fit. "
        f"{advice}"
    ] if why else []
