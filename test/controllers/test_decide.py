"""When a controller decides, on which forecast, and which commands are invalid."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
import pytest

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.controllers.decide import decide, rain_forecast
from greenroof_ros.controllers.registry import find_controller


class Answering:
    """Gives the same answer to everything, and counts the ticks that are skipped."""

    parameters = ()

    def __init__(self, answer: Any) -> None:
        self._answer = answer
        self.skipped = 0

    def command(self, *inputs: Any) -> Any:
        return self._answer

    def skip(self) -> None:
        self.skipped += 1

    def statistics(self) -> None:
        return None


def test_a_command_is_passed_on() -> None:
    for answer in (0.0, 7, np.float64(0.5)):
        controller = Answering(answer)
        assert decide(controller, True, 2.0, 0.03, [0.0], [0.0]) == answer
        assert controller.skipped == 0


def test_where_pumping_is_not_allowed_the_tick_is_skipped() -> None:
    controller = Answering(0.3)
    assert decide(controller, False, 2.0, 0.03, [0.0], [0.0]) == 0.0
    assert controller.skipped == 1


@pytest.mark.parametrize("answer", [-0.5, math.nan, math.inf, "0.5", None])
def test_what_is_no_command_ends_the_run(answer: Any) -> None:
    """It could pump water out of the roof, or fail in the middle of the plant."""
    with pytest.raises(ConfigurationError, match=r"the command of Answering.*must be a finite num"):
        decide(Answering(answer), True, 2.0, 0.03, [0.0], [0.0])


def test_a_forecast_has_the_shape_that_the_controller_takes() -> None:
    """All members for lookahead, even if there is one; a row for a controller that takes one."""
    row, members = array("d", [1.0, 2.0]), np.ones((3, 2))
    assert rain_forecast(find_controller("onoff"), row, "/rain") is row
    assert np.array_equal(rain_forecast(find_controller("lookahead"), row, "/rain"), [[1.0, 2.0]])
    assert rain_forecast(find_controller("lookahead"), members, "/rain").shape == (3, 2)
    with pytest.raises(ConfigurationError, match=r"^/rain: has 3 members, but onoff takes one"):
        rain_forecast(find_controller("onoff"), members, "/rain")
