"""Whether a fit is worth anything: no parameters of a roof follow a record that is not true."""

from __future__ import annotations

import math
from collections.abc import Sequence

from greenroof_ros.calibration.record import Record
from greenroof_ros.calibration.scores import HOUR_S, ScoreRow, time_name
from greenroof_ros.common.errors import ConfigurationError

# Simulated too much or too little by this share, runoff is not that of the roof.
_VOLUME_OFF = 0.5
_LOOK_AT = (
    "Look at units, at clocks that are shifted, at sensors that are stuck or blocked, and at a2 "
    "and z_soil of the site."
)


def refuse_hopeless(record: Record, rows: Sequence[ScoreRow]) -> None:
    """Refuse a fit that is worse than the mean of what was measured, wherever one looks.

    That is an NSE below 0 of hours (or the steps, where they are longer) and of days, in the fit
    and in the validation, of everything that was measured. The mean of the record alone has 0, so
    nothing was found.

    Raises:
        ConfigurationError: it is so.
    """
    if all(_hopeless(row) for row in rows):
        scores = "; ".join(
            f"{row.quantity}, {row.part}: {_listed(row, _times(row))}" for row in rows
        )
        raise ConfigurationError(
            f"no roof fits this record, so nothing is written: NSE of {scores}, and the mean of "
            f"what was measured has 0. {_LOOK_AT}", file=record.source,
        )


def warning(rows: Sequence[ScoreRow]) -> str:
    """Say that a fit must not be used; empty where nothing speaks against it.

    What speaks against it is found in the validation: an NSE of days below 0, of hours (or longer
    steps) where there are too few days, or a volume that is wrong by more than half.
    """
    worse, off = [], []
    for row in rows:
        if row.part != "validation":
            continue
        nse = row.scores.nse
        known = [over_s for over_s in reversed(_times(row)) if not math.isnan(nse[over_s])]
        if known and nse[known[0]] < 0:
            worse.append(f"NSE of {row.quantity} {_listed(row, known[:1])}")
        if row.quantity == "runoff" and abs(row.scores.volume_error) > _VOLUME_OFF:
            off.append(f"volume of runoff {100 * row.scores.volume_error:+.0f} %")
    if not worse and not off:
        return ""
    what = "worse than the mean of what was measured" if worse else "wrong by much"
    return (
        f"This fit is {what} in the half that it has not seen ({', '.join(worse + off)}): do not "
        f"use it. {_LOOK_AT}"
    )


def _hopeless(row: ScoreRow) -> bool:
    known = [row.scores.nse[over_s] for over_s in _times(row)]
    known = [value for value in known if not math.isnan(value)]
    return bool(known) and max(known) < 0


def _times(row: ScoreRow) -> list[int]:
    return [over_s for over_s in row.scores.nse if over_s >= HOUR_S]


def _listed(row: ScoreRow, times: Sequence[int]) -> str:
    return " and ".join(f"{row.scores.nse[over_s]:.2f} ({time_name(over_s)})" for over_s in times)
