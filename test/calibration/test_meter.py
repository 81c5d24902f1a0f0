"""What a runoff meter shows: a counter everything in the end, a flow meter nothing small."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from greenroof_ros.calibration.meter import least_reading, through_meter
from greenroof_ros.calibration.record import Record


def a_record(runoff: np.ndarray | None, last_decimal: float = 0.0) -> Record:
    nothing = np.zeros(6)
    return Record(
        Path("none"), datetime(2021, 5, 1, tzinfo=timezone.utc), 300.0, nothing, nothing, nothing,
        runoff, None, last_decimal,
    )


def test_a_counter_of_tips_misses_nothing() -> None:
    """Tips of a litre off 194 m2, as in Berlin."""
    tip = 1 / 194
    assert least_reading(a_record(np.array([0, tip, 2 * tip, 0, 60 * tip, np.nan]))) == 0.0


@pytest.mark.parametrize("tip", [0.0396, 0.0297, 0.099, 0.0254])
def test_a_counter_may_be_printed_with_two_decimals(tip: float) -> None:
    counts = np.random.default_rng(4).geometric(0.1, 500)
    assert counts.max() > 40
    printed = np.array([float(f"{count * tip:.2f}") for count in counts])
    assert least_reading(a_record(printed, 0.01)) == 0.0
    assert least_reading(a_record(printed)) > 0.0  # with more decimals it would be no counter


@pytest.mark.parametrize("least", [0.02, 0.03, 0.05, 0.1])
def test_a_flow_meter_printed_with_two_decimals_is_no_counter(least: float) -> None:
    flows = least + np.random.default_rng(5).exponential(0.2, 500)
    printed = np.round(flows, 2)
    assert least_reading(a_record(printed, 0.01)) == printed.min()


def test_a_flow_meter_shows_nothing_below_its_least() -> None:
    """The lowest readings of Neubrandenburg's, which are of no common tip."""
    readings = np.array([0, 0.00605509, 0.01215386, 0.01829655, 0.02448339, 0.03071464])
    least = least_reading(a_record(readings))
    assert least == pytest.approx(0.00605509)
    assert through_meter(np.array([0.001, 0.006, 0.0061, 0.5]), least).tolist() == [
        0.0, 0.0, 0.0061, 0.5,
    ]


def test_without_a_meter_nothing_is_lost() -> None:
    assert least_reading(a_record(None)) == 0.0
    assert least_reading(a_record(np.zeros(6))) == 0.0
    assert through_meter(np.array([1e-9]), 0.0).tolist() == [1e-9]
