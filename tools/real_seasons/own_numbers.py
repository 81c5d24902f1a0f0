"""The numbers of dressing, chosen by the issues that dress, and by no others.

The package's numbers (members, hours between analogs, largest ratio of a block) were chosen on the
whole record. To see whether that flatters the tables, each half of a period chooses its own: those
whose members have the least CRPS of sums over 12 and 48 h in that half, each issue without the days
around it. The other half is then dressed with them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from typing import NamedTuple

import numpy as np

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast import dressing
from greenroof_ros.forecast.dressing import Dressing
from greenroof_ros.formats.records import Archive
from greenroof_ros.verification.scores import crps

_SUMS_H = (12, 48)


class Numbers(NamedTuple):
    """What may be chosen in :mod:`greenroof_ros.forecast.dressing`."""

    members: int
    apart: int
    ratio: float


PACKAGE = Numbers(dressing.MEMBERS, dressing._APART, dressing._MOST_RATIO)
# A ratio of 1 leaves the analogs as they fell.
TRIED = [
    Numbers(*numbers)
    for numbers in product((5, 10, 15, 20), (24, 48, 96), (1.0, 2.0, 4.0, 8.0))
]


@contextmanager
def used(numbers: Numbers) -> Iterator[None]:
    """Dress with other numbers than the package's."""
    dressing.MEMBERS, dressing._APART, dressing._MOST_RATIO = numbers
    try:
        yield
    finally:
        dressing.MEMBERS, dressing._APART, dressing._MOST_RATIO = PACKAGE


def chosen(archive: Archive, by: Dressing) -> Numbers:
    """Return the numbers with the least CRPS, each sum's as a share of the package's numbers'."""
    package = _scores(archive, by, PACKAGE)
    assert package is not None
    tried = {numbers: _scores(archive, by, numbers) for numbers in TRIED}
    means = {
        numbers: float(np.mean(scores / package))
        for numbers, scores in tried.items() if scores is not None
    }
    return min(means, key=means.__getitem__)


def _scores(archive: Archive, by: Dressing, numbers: Numbers) -> np.ndarray | None:
    """Return the mean CRPS of each sum (mm); None if an issue has too few analogs."""
    issues = {hours_since_1970(issue.issued): issue for issue in archive.issues}
    scores = []
    with used(numbers):
        for issued, fell in zip(by.issued, by.fell, strict=True):
            try:
                members = by.members(int(issued), issues[int(issued)].rain)
            except ConfigurationError:
                return None
            scores.append([
                crps(members[:, :hours].sum(axis=1)[:, None], fell[:hours].sum()[None])[0]
                for hours in _SUMS_H
            ])
    return np.mean(scores, axis=0)
