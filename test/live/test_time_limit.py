"""The time limit of a live controller."""

from __future__ import annotations

import time
from contextlib import suppress

import pytest

from greenroof_ros.base.errors import HangError
from greenroof_ros.live.upkeep import deciding_limit, silence_limit
from greenroof_ros.ros.watchdog import time_limit


def test_code_that_does_not_return_is_ended_even_if_it_catches_the_error() -> None:
    """Code that returns in time is not, however often the limit begins."""
    for _ in range(10):
        with time_limit(0.5):
            time.sleep(0.1)
    began = time.monotonic()

    def hang() -> None:
        with time_limit(0.5), suppress(HangError):
            time.sleep(60)
        with time_limit(0.5):
            try:
                time.sleep(60)
            except HangError:
                time.sleep(60)

    with pytest.raises(HangError, match=r"did not return within 0.5 s; it was executing .*, line"):
        hang()
    assert time.monotonic() - began < 5


@pytest.mark.parametrize(("tau", "decides", "silent"), [(1.0, 3.0, 5.0), (8.0, 8.0, 10.0)])
def test_a_controller_that_may_still_decide_is_not_killed(
    tau: float, decides: float, silent: float
) -> None:
    assert (deciding_limit(tau), silence_limit(tau)) == (decides, silent)
