"""What is most likely wrong with an archive: leads that lack water, rain of another place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import median

from greenroof_ros.verification.pairs import Class
from greenroof_ros.verification.scores import Tally

# In a quarter of a year few storms make such differences, in a year none (h).
_LEAST_HOURS = 8760
# Of the median of the other leads, or its inverse. In any 365 days of Open-Meteo's previous runs of
# GEM, GFS and KNMI (2024-02 to 2026-02) a day had 0.60 to 1.37 times the others' water, and GFS's
# fifth day, half of which is missing there, 0.36 to 0.52.
_LEAST_SHARE = 0.55
# The least of the services five days ahead is 0.32 (sums over 12 h; the package's table of skill).
# Of so many pairs that know nothing of one another hardly one in a thousand has so much.
_LEAST_R, _LEAST_PAIRS = 0.1, 1000


def archive_faults(tallies: Mapping[Class, Tally], *, previous_runs: bool) -> list[str]:
    """Return what is most likely wrong, each in a sentence without its full stop.

    Args:
        tallies: what adds up in each class.
        previous_runs: whether these are previous runs, whose leads may lack water.
    """
    found = [
        f"{lead} has {ratio:.2f} times the water of the other leads, most likely by an error of "
        "the archive; --horizon leaves late leads out"
        for lead, ratio in (_odd_leads(tallies) if previous_runs else {}).items()
    ]
    if _unrelated(tallies):
        found.append(
            "these forecasts know nothing of these records, no correlation reaches 0.1: are both "
            "of the same place, and the hours of both right?"
        )
    return found


def _odd_leads(tallies: Mapping[Class, Tally]) -> dict[str, float]:
    """Return the leads, in words, whose water is not that of the others, and the ratio (1).

    The water of a lead is its bias, so that its missing hours do not count, and is held against
    the median of the other leads: less than 0.55 of that, or more than 1 / 0.55, is odd. A forecast
    of the far future may be worse, but a model's climate stays what it is. Leads with less than a
    year, and less than two other leads, tell nothing.

    Args:
        tallies: of previous runs, where each pair of a lead is of other hours.
    """
    water: dict[str, float] = {}
    for one, tally in tallies.items():
        scores = tally.scores()
        if scores.n * one.sum.hours >= _LEAST_HOURS and not math.isnan(scores.bias):
            water.setdefault(one.lead, scores.bias)
    if len(water) < 3:
        return {}
    found = {}
    for lead, bias in water.items():
        usual = median(other for name, other in water.items() if name != lead)
        if not _LEAST_SHARE * usual <= bias <= usual / _LEAST_SHARE:
            found[lead] = bias / usual if usual else math.inf
    return found


def _unrelated(tallies: Mapping[Class, Tally]) -> bool:
    """Return whether forecasts know nothing of the records: r is below 0.1 in each class.

    Classes of less than 1000 pairs tell nothing, nor do those in which one of the two is the same
    all the time.
    """
    told = [scores.r for scores in (tally.scores() for tally in tallies.values())
            if scores.n >= _LEAST_PAIRS and not math.isnan(scores.r)]
    return bool(told) and max(told) < _LEAST_R
