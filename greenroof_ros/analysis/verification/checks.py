"""Checks for likely errors in an archive: leads with too little water, or the wrong location."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import median

from greenroof_ros.analysis.verification.pairs import Class
from greenroof_ros.analysis.verification.scores import ForecastScores, Tally

# Minimum record (h). In three months, a few storms can make such differences; in a year they do
# not.
_MIN_HOURS = 8760
# Minimum ratio to the median of the other leads; its inverse is the maximum. In any 365 days of
# Open-Meteo's previous runs of GEM, GFS and KNMI (2024-02 to 2026-02), a day had 0.60 to 1.37 times
# the others' water. GFS's fifth day, half of which is missing there, had 0.36 to 0.52.
_MIN_SHARE = 0.55
# The lowest r of the services five days ahead is 0.32 (sums over 12 h; the package's table of
# skill). With this many unrelated pairs, r reaches the limit in hardly one case in a thousand.
_MIN_R, _MIN_PAIRS = 0.1, 1000


def check_forecasts(tallies: Mapping[Class, Tally], *, previous_runs: bool) -> list[str]:
    """Return the likely errors in the forecasts, each described in a sentence.

    Args:
        tallies: tally of every class.
        previous_runs: whether the forecasts are previous runs, whose leads can contain too little
            water.
    """
    scores = {key: tally.scores() for key, tally in tallies.items()}
    warnings = [
        f"{lead} contains {ratio:.2f} times the rain of the other lead times, most likely because "
        "of an error in the archive; --horizon excludes long lead times"
        for lead, ratio in (_find_odd_leads(scores) if previous_runs else {}).items()
    ]
    # Classes with few pairs tell nothing, nor do classes whose forecast or rain never varies.
    known = [
        score.r for score in scores.values()
        if score.n >= _MIN_PAIRS and not math.isnan(score.r)
    ]
    if known and max(known) < _MIN_R:
        warnings.append(
            f"the forecasts are unrelated to the records: no correlation reaches {_MIN_R:g}. Are "
            "the forecasts and the records for the same location, and are their times correct?"
        )
    return warnings


def _find_odd_leads(scores: Mapping[Class, ForecastScores]) -> dict[str, float]:
    """Return the leads, in words, whose water differs from that of other leads, and the ratios (1).

    The water of a lead is measured by its bias, which leaves out the hours that the lead lacks. A
    lead is odd if its water is less than 0.55 times or more than 1 / 0.55 times the median of the
    other leads. The reason is that a model's climate does not change with the lead, even if its
    forecasts get worse. Leads with less than one year of hourly values are left out. If fewer than
    three leads remain, no lead is odd.

    Args:
        scores: scores of previous runs, where all pairs with the same lead cover different hours.
    """
    water: dict[str, float] = {}
    for key, of_class in scores.items():
        if of_class.n * key.sum.hours >= _MIN_HOURS and not math.isnan(of_class.bias):
            water.setdefault(key.lead, of_class.bias)
    odd = {}
    for lead, bias in water.items() if len(water) > 2 else ():
        usual = median(share for name, share in water.items() if name != lead)
        if not _MIN_SHARE * usual <= bias <= usual / _MIN_SHARE:
            odd[lead] = bias / usual if usual else math.inf
    return odd
