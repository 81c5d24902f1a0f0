"""The one check of numbers: what is accepted, and the sentence about what is not."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusals import refusal

from greenroof_ros.base.ranges import Range


@pytest.mark.parametrize(("allowed", "wrong"), [
    (Range(-0.1, 2.5, "m"), "2,5"),
    (Range(), 10**400),  # which no float can hold
    (Range(0.0, words=("max",)), "fast"),
])
def test_what_no_range_contains(allowed: Range, wrong: object) -> None:
    with pytest.raises(ValueError, match=r"^must be a"):
        allowed.check(wrong)


@given(value=st.floats() | st.integers(), low=st.floats(-1e6, 1e6), width=st.floats(0, 1e6))
def test_what_is_accepted(value: float, low: float, width: float) -> None:
    """Any number between the ends and at the ends; written as text, too."""
    allowed = Range(low, low + width)
    try:
        assert allowed.check(value) == allowed.parse(str(value)) == value
    except ValueError:
        assert math.isnan(value) or not low <= value <= low + width
    else:
        assert low <= value <= low + width


@given(value=st.floats(-10, 10) | st.integers(-10, 10))
def test_a_whole_number_in_a_file(value: float) -> None:
    """It may be written as 5.0, and becomes an int."""
    allowed = Range(0, 5, "ticks", whole=True)
    read = partial(allowed.read, file=Path("a.yaml"), line=7, key="n")
    if value in range(6):
        number = read(value)
        assert (type(number), number) == (int, value)
    else:
        reason = refusal(read, value)
        assert reason.startswith(f"a.yaml, line 7: n = {value!r}: must be a whole number")
