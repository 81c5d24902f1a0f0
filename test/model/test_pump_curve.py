"""The pump curve of a data sheet, Eq. (3b)."""

from __future__ import annotations

import pytest

from greenroof_ros.model.pump_curve import fit_pump_curve


def test_three_points_by_hand() -> None:
    """Heads 6, 4, 1 m at y^2 = 0, 1, 4 (1e-6 m6/s2), by the normal equations.

    The means are 11/3 and 5/3, the sums of products about them -31/3 and 26/3: the slope is
    -31/26, and the head at 0 is 11/3 + 31/26 5/3 = 147/26.
    """
    curve = fit_pump_curve([0, 0.001, 0.002], [6, 4, 1])
    assert curve == pytest.approx((-31 / 26 * 1e6, 147 / 26), rel=1e-12)


@pytest.mark.parametrize(
    ("flow", "head", "reason"),
    [
        ([], [], "two different flows"),
        ([0.01, 0.01], [50, 40], "two different flows"),
        ([0, 0.005, 0.01], [50, 50, 50 - 1e-9], "must fall"),
    ],
)
def test_refusals(flow: list[float], head: list[float], reason: str) -> None:
    """Each error states what is needed."""
    with pytest.raises(ValueError, match=reason):
        fit_pump_curve(flow, head)
