"""The knee and the target, with values computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from greenroof_ros.analysis.sizing.designs import find_knee, find_target

VOLUMES = [1.0, 2.0, 4.0, 8.0]


@pytest.mark.parametrize(("saved", "amount", "knee"), [
    ([0, 5, 7, 7.4], 1.0, 2),  # 5, 1 and 0.1 m3 for each m3
    ([0, 5, 7, 7.4], 1.01, 1),
    ([0, 0.9, 1.0, 1.1], 1.0, 0),
    ([0, 0.5, 3.5, 3.6], 1.0, 2),  # a m3 that brings little, before one that brings much
    ([0, 5, 10, 20], 1.0, 3),  # the largest may be too small
    ([0, 0, 0, 0], 0.0, 3),  # at least nothing is always brought
])
def test_knee(saved: list[float], amount: float, knee: int) -> None:
    """It is the smallest volume from which on every further m3 brings less than the amount."""
    assert find_knee(VOLUMES, np.array(saved), amount) == knee


@pytest.mark.parametrize(("lost", "target"), [
    ([0.2, 0.001, 0.0], 39.0), ([0.2, 0.05, 0.02], 43.0), ([0.0, 0.0, 0.0], 35.0),
])
def test_target(lost: list[float], target: float) -> None:
    """The lowest at which at most 0.1 % is lost, or else the one at which least is lost."""
    assert find_target([35.0, 39.0, 43.0], np.array(lost)) == target
