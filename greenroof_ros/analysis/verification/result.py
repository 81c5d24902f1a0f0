"""A verification: the scores of an archive of forecasts against records, by lead and sum."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from greenroof_ros.analysis.verification.pairs import Class, Sum, read_issued_forecasts, tally_pairs
from greenroof_ros.analysis.verification.scores import SHOWN, ForecastScores
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import default_site_file
from greenroof_ros.base.times import to_people
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.site.file import read_site
from greenroof_ros.weather.read import find_files, read_weather
from greenroof_ros.weather.summary import as_lines, summarize

if TYPE_CHECKING:
    import polars

# Default sums: hours, and the mm from which such a sum counts as an event.
_SUMS = ((1, 1.0), (6, 2.0), (12, 3.0), (24, 5.0))
# The lowest r of the services five days ahead is 0.32 (sums over 12 h; the package's table of
# skill). With this many unrelated pairs, r reaches the limit in hardly one case in a thousand.
_MIN_R, _MIN_PAIRS = 0.1, 1000


@dataclass(frozen=True)
class Verification:
    """Scores of forecasts against records.

    Attributes:
        title: what was compared, in words.
        scores: scores of every class of leads and sums.
        notes: sentences about the data.
        warnings: what is most likely wrong with the data.
    """

    title: str
    scores: Mapping[Class, ForecastScores]
    notes: Sequence[str]
    warnings: Sequence[str]

    def rows(self) -> list[dict[str, Any]]:
        """Return the scores as rows; None for a score that is undefined."""
        return [
            {
                "lead_from_h": key.low, "lead_to_h": key.high, "sum_hours": key.sum.hours,
                "event_mm": key.sum.event,
                **{
                    "crps_mm" if name == "crps" else name:
                        None if math.isnan(value := getattr(score, name)) else value
                    for name in SHOWN
                },
            }
            for key, score in self.scores.items()
        ]

    @property
    def table(self) -> polars.DataFrame:
        """The scores, with one row for each class of leads and sums; see :meth:`rows`.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame(self.rows())


def verify(
    forecasts: str | os.PathLike[str], weather: Sequence[str], site: str | os.PathLike[str] = "",
    *, lead: int = 24, sums: Sequence[int] | None = None, events: Sequence[float] | None = None,
    horizon: int = 120, progress: Callable[[str, float], None] = lambda text, share: None,
) -> Verification:
    """Score rain forecasts against records, like ``greenroof verify``.

    Args:
        forecasts: archive of forecasts: a file, or a directory of files.
        weather: files with the records, or patterns.
        site: site file with the location; by default the paper's.
        lead: length of the blocks of lead time that are scored together (h).
        sums: numbers of hours over which rain is summed; by default those of 1, 6, 12 and 24 that
            divide ``lead``.
        events: amounts from which each of the sums counts as an event (mm).
        horizon: maximum lead time (h).
        progress: callback that receives the current task, and the share that is done.

    Raises:
        ConfigurationError: if an input is invalid, or if forecasts and records have no complete sum
            in common.

    Example:
        >>> import greenroof_ros as gr
        >>> gr.verify("gem_previous_runs.csv", ["gauge.csv"]).table  # doctest: +SKIP
    """
    lengths = _read_sums(lead, sums, events)
    place = read_site(Path(site) if site else default_site_file())
    records = read_weather(find_files(weather, "weather"), place, method="")
    issued = read_issued_forecasts(Path(forecasts), records, place, horizon)
    if lead % issued.finest_lead:
        raise ConfigurationError(
            f"must be a multiple of {issued.finest_lead} h, the finest lead time of "
            f"{issued.name}", key="lead", value=lead,
        )
    count = len(issued.issues)
    tallies = tally_pairs(
        issued, records.precipitation, lead, lengths,
        lambda done: progress(f"verifying: {done} of {count} forecasts", done / count),
    )
    scores = {key: tally.scores() for key, tally in tallies.items()}
    if not any(score.n for score in scores.values()):
        raise ConfigurationError(
            "include no complete sum in the period of the records: the forecasts cover "
            f"{issued.span}, and the records cover {to_people(records.first)} to "
            f"{to_people(records.end)}", file=Path(forecasts),
        )
    known = [score.r for score in scores.values() if score.n >= _MIN_PAIRS and score.r == score.r]
    warnings = [
        f"the forecasts are unrelated to the records: no correlation reaches {_MIN_R:g}. Are the "
        "forecasts and the records for the same location, and are their times correct?"
    ] if known and max(known) < _MIN_R else []
    return Verification(
        f"{issued.name}: {count} forecasts, compared with {records.source}", scores,
        [*as_lines(summarize(records, place)), *filter(None, [records.rain_note]),
         *records.left_out, *issued.notes], warnings,
    )


def _read_sums(
    lead: int, sums: Sequence[int] | None, events: Sequence[float] | None
) -> list[Sum]:
    """Return the sums to score, each with the amount that counts as an event."""
    if sums is None and events is None:
        return [Sum(*values) for values in _SUMS if lead % values[0] == 0]
    if sums is None or events is None or len(sums) != len(events):
        raise ConfigurationError("must be used together, with as many values", key="sums, events")
    for hours in sums:
        if lead % hours or sums.count(hours) > 1:
            raise ConfigurationError(
                f"must be a divisor of lead ({lead} h), and be given only once", key="sums",
                value=hours,
            )
    return [Sum(*values) for values in zip(sums, events, strict=True)]
