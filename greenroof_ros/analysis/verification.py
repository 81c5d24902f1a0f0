"""A verification: the scores of an archive of forecasts against records, by lead and sum.

The scores are implemented here, in a few lines each. Among the libraries that offer these scores,
``scores`` needs xarray, pandas and bottleneck; ``scoringrules`` needs Python 3.11, and
``properscoring`` had its only release in 2015. The tests compare the scores with worked examples,
closed forms and other methods of computation.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.times import to_people
from greenroof_ros.forecast.issue import IssuedForecast, read_archive
from greenroof_ros.results.table import make_frame
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import find_files, read_weather
from greenroof_ros.weather.records import HOUR, Array
from greenroof_ros.weather.series import Weather
from greenroof_ros.weather.summary import as_lines, summarize

if TYPE_CHECKING:
    import polars

# Hours over which rain is summed, and the mm from which such a sum counts as an event.
_EVENTS = {1: 1.0, 6: 2.0, 12: 3.0, 24: 5.0}
# Decimals to which sums are rounded (mm). In binary numbers, tenths of a millimetre do not add up
# to whole millimetres, which are the thresholds of events.
_DIGITS = 6


@dataclass(frozen=True)
class Verification:
    """Scores of forecasts against records.

    Attributes:
        title: what was compared, in words.
        rows: a row for each class of leads and sums: ``lead_from_h``, ``lead_to_h``, ``sum_hours``,
            ``event_mm`` and the scores; None for a score that is undefined.
        notes: sentences about the data.
    """

    title: str
    rows: Sequence[dict[str, Any]]
    notes: Sequence[str]

    @property
    def table(self) -> polars.DataFrame:
        """The rows as a data frame.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame(self.rows)


def verify(
    forecasts: str | os.PathLike[str], weather: Sequence[str], site: str | os.PathLike[str] = "",
    *, lead: int = 24, horizon: int = 120,
) -> Verification:
    """Score rain forecasts against records, like ``greenroof verify``.

    A pair consists of a sum over consecutive hours of a forecast, and the sum over the same hours
    of the records: over 1, 6, 12 and 24 h, as far as these divide ``lead``. A forecast is divided
    from its start: for sums of 12 h, into its first 12 hours, the next 12 hours, and so on. Every
    sum belongs to the class of leads into which it falls. A sum is left out if one of its hours is
    missing from the forecast or the records.

    Args:
        forecasts: archive of forecasts: a file, or a directory of files.
        weather: files with the records, or patterns.
        site: site file with the location; by default the paper's.
        lead: length of the blocks of lead time that are scored together (h).
        horizon: maximum lead time (h).

    Raises:
        ConfigurationError: if an input is invalid, or if forecasts and records have no complete sum
            in common.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.verify("gem_previous_runs.csv", ["gauge.csv"]).table  # doctest: +SKIP
    """
    place = read_site(Path(site) if site else default_site_file())
    records = read_weather(find_files(weather, "weather"), place, method="")
    issues = read_archive(Path(forecasts), place, daily=True)
    if lead % issues[0].finest_lead:
        raise ConfigurationError(
            f"must be a multiple of {issues[0].finest_lead} h, the finest lead time of "
            f"{forecasts}", key="lead", value=lead,
        )
    rain, fallen = pair_hours(issues, records, horizon, lead)
    rows = []
    for begin in range(0, rain.shape[2], lead):
        for hours, event in _EVENTS.items():
            if lead % hours:
                continue
            predicted, fell = (
                np.round(
                    each[..., begin:begin + lead].reshape(len(each), -1, hours).sum(2), _DIGITS
                ) for each in (rain, fallen)
            )
            rows.append({
                "lead_from_h": begin, "lead_to_h": begin + lead, "sum_hours": hours,
                "event_mm": event, **score_pairs(predicted, fell[0], event),
            })
    if not any(row["n"] for row in rows):
        raise ConfigurationError(
            "include no complete sum in the period of the records, "
            f"{to_people(records.first)} to {to_people(records.end)}", file=Path(forecasts),
        )
    return Verification(
        f"{forecasts}: {len(issues)} forecasts, compared with {records.source}",
        [{name: None if value != value else value for name, value in row.items()} for row in rows],
        [*as_lines(summarize(records, place)), *filter(None, [records.rain_note]),
         *records.left_out, *dict.fromkeys(note for issue in issues for note in issue.notes)],
    )


def pair_hours(
    issues: Sequence[IssuedForecast], records: Weather, horizon: int, lead: int
) -> tuple[Array, Array]:
    """Return the hours of forecasts, and the same hours of the records.

    The forecasts are compared with the rain at the time at which it fell, even if the records count
    it later (``rain_late``).

    Args:
        issues: the forecasts.
        records: the records.
        horizon: number of hours to compare in each forecast.
        lead: number of hours of which the compared hours are a multiple.

    Returns:
        Rain of the forecasts (mm/h), shape (members, forecasts, hours), and rain of the records,
        shape (1, forecasts, hours), both NaN if missing.
    """
    aligned = [issue.align(records.first) for issue in issues]
    longest = min(horizon, max(issue.hours for issue in aligned))
    reach = math.ceil(longest / lead) * lead
    rain = np.full((len(issues[0].rain), len(aligned), reach), math.nan)
    for place, issue in enumerate(aligned):
        hours = min(longest, issue.hours)
        rain[:, place, :hours] = issue.rain[:, :hours]
    first = records.first - (1 + records.rain_late) * HOUR  # an unknown hour before the records
    begins = [(issue.issued - first) // HOUR for issue in aligned]
    known = np.concatenate(([math.nan], records.precipitation, [math.nan]))
    return rain, known.take(np.add.outer(begins, np.arange(reach)), mode="clip")[None]


SCORES = {
    "n": ("n", "d"), "bias": ("bias", ".2f"), "r": ("r", ".2f"), "pod": ("POD", ".2f"),
    "far": ("FAR", ".2f"), "ets": ("ETS", ".2f"), "brier": ("Brier", ".3f"),
    "crps_mm": ("CRPS mm", ".3f"),
}
"""heading and format of every score"""


def score_pairs(forecast: Array, observed: Array, event: float) -> dict[str, float]:
    """Return the scores of pairs of forecast and observed sums, by name; NaN if undefined.

    The scores are the number of pairs (``n``), the total of the forecasts over that of the
    observations (``bias``), Pearson's correlation (``r``), three scores of events (Wilks 2011,
    Sect. 8.2), the mean squared difference between the event's probability and its outcome, 1 or 0
    (``brier``), and the mean of :func:`crps` (``crps_mm``). The Brier score and the CRPS are scores
    of all members. The others are scores of member 0, which is the forecast given to controllers
    that use a single member.

    The probability of detection (``pod``) is hits over observed events, the false alarm ratio
    (``far``) is false alarms over forecast events. The equitable threat score (``ets``, Gilbert
    skill score) is hits over all events that were forecast or observed, after subtracting the hits
    expected by chance from both: (hits - a) / (observed + forecast - hits - a), where a is observed
    events times forecast events over pairs. It is 1 for a perfect forecast, and 0 for a forecast
    without skill.

    Args:
        forecast: forecast sums (mm), shape (members, pairs); a pair with NaN is left out.
        observed: observed sums (mm), shape (pairs,); a pair with NaN is left out.
        event: minimum sum of an event (mm).
    """
    known = ~(np.isnan(observed) | np.isnan(forecast).any(axis=0))
    forecast, observed = forecast[:, known], observed[known]
    if not observed.size:
        return dict.fromkeys(SCORES, math.nan) | {"n": 0}
    single = forecast[0]
    varies = np.ptp(single) > 0 and np.ptp(observed) > 0
    fell, warned = observed >= event, single >= event
    events, alarms, hits = (int(each.sum()) for each in (fell, warned, fell & warned))
    chance = events * alarms / observed.size
    probability = np.mean(forecast >= event, axis=0)
    return {
        "n": observed.size, "bias": _ratio(single.sum(), observed.sum()),
        "r": float(np.corrcoef(single, observed)[0, 1]) if varies else math.nan,
        "pod": _ratio(hits, events), "far": _ratio(alarms - hits, alarms),
        "ets": _ratio(hits - chance, events + alarms - hits - chance),
        "brier": float(np.mean((probability - fell) ** 2)),
        "crps_mm": float(np.mean(crps(forecast, observed))),
    }


def crps(forecast: Array, observed: Array) -> Array:
    """Return the fair continuous ranked probability score of every pair (mm).

    The score is the integral over x of the squared difference between the members' distribution and
    the observation's step function (Hersbach 2000, Eq. 1). For M members x_i and the observation y,
    the fair score is

        sum_i |x_i - y| / M - sum_ij |x_i - x_j| / (2 M (M - 1))

    (Ferro 2014, doi:10.1002/qj.2270). Its mean is the CRPS of infinitely many members, so ensembles
    of different sizes can be compared. With one member it is the absolute error, so single
    forecasts can be compared, too. The second sum is computed from the sorted members x_(1) to
    x_(M) as 2 sum_i (2 i - M - 1) x_(i).

    Args:
        forecast: forecast sums (mm), shape (members, pairs).
        observed: observed sums (mm), shape (pairs,).
    """
    members = len(forecast)
    errors = np.mean(np.abs(forecast - observed), axis=0)
    spread = np.arange(1.0 - members, members, 2.0) @ np.sort(forecast, axis=0)
    score: Array = errors - spread / max(members * (members - 1), 1)
    return score


def _ratio(part: float, whole: float) -> float:
    """Return a ratio; NaN if the denominator is 0."""
    return float(part / whole) if whole else math.nan
