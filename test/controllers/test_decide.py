"""When a controller decides, on which forecast, and which commands are invalid."""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paper import PAPER_SITE

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.decide import (
    ControllerError,
    TickTimes,
    decide,
    read_statistics,
)
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


@pytest.mark.parametrize("answer", [0.0, 7, np.float64(0.5), np.float32(0.5), np.int64(1)])
def test_a_command_is_passed_on_unless_the_tick_is_skipped(answer: Any) -> None:
    controller = Answering(answer)
    command = decide(controller, True, 2.0, 0.03, [0.0], [0.0])
    assert (command, type(command)) == (answer, float)
    assert controller.skipped == 0
    assert decide(controller, False, 2.0, 0.03, [0.0], [0.0]) == 0.0
    assert controller.skipped == 1


def test_quiet_hours() -> None:
    """A controller that uses the time is called, but not obeyed; any other one skips the tick."""
    for knows in (False, True):
        controller = Answering(0.5)
        if knows:
            controller.time_ns = 0  # type: ignore[attr-defined]
        assert decide(controller, True, 2.0, 0.03, [0.0], [0.0], quiet=True) == 0.0
        assert controller.skipped == (not knows)


@pytest.mark.parametrize("answer", [-0.5, math.nan, np.float32("inf"), 10**400, True, "0.5", None])
def test_what_is_no_command_ends_the_run(answer: Any) -> None:
    """It could pump water out of the roof, or fail in the middle of the plant."""
    with pytest.raises(ConfigurationError, match=r"the command of Answering.*must be a finite num"):
        decide(Answering(answer), True, 2.0, 0.03, [0.0], [0.0])


class Raising(Answering):
    """Raises in a method of its own, in one of a library, or takes too few values."""

    def __init__(self, site: Any = None, answer: Any = None) -> None:
        super().__init__(answer)
        if site is not None:
            math.sqrt(-1.0)

    def skip(self) -> None:
        json.loads("{")

    def statistics(self) -> None:
        raise SystemError


class Deaf(Answering):
    """Takes no forecasts."""

    def command(self, cistern: float, roof: float) -> float:  # type: ignore[override]
        return 0.0


def line_of(text: str) -> int:
    """Return the first line of this file with a text."""
    lines = Path(__file__).read_text().splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


@pytest.mark.parametrize(("call", "line", "why"), [
    (lambda: find_controller(f"{__name__}:Raising").make(PAPER_SITE, {}), "math.sqrt", "ValueErr"),
    (lambda: decide(Raising(), False, 2.0, 0.03, [], []), "json.loads", "JSONDecodeError"),
    (lambda: read_statistics(Raising()), "raise SystemError", "SystemError"),
    (lambda: decide(Deaf(0.0), True, 2.0, 0.03, [], []), "roof: float) -> float", "TypeError"),
    (lambda: decide(Answering(None), True, 2.0, 0.03, [], []), "def command", "= None: must be"),
])
def test_an_error_of_a_class_names_file_and_line(
    call: Callable[[], object], line: str, why: str
) -> None:
    """It is one line of a command's output, without a traceback."""
    with pytest.raises(ControllerError, match=f"^{__file__}, line {line_of(line)}: .*{why}"):
        call()


def test_a_forecast_has_the_shape_that_the_controller_takes() -> None:
    """All members for lookahead, even if there is one; otherwise the first, if it has more."""
    row, members, dry = array("d", [1.0, 2.0]), np.ones((3, 2)), array("d", [0.0, 0.0])
    lookahead, onoff = find_controller("lookahead"), find_controller("onoff")
    assert onoff.own_forecast(None, row, dry) == (row, dry)
    assert onoff.own_forecast(1, members, dry) == (array("d", [1.0]), dry[:1])
    assert np.array_equal(lookahead.own_forecast(None, row, dry)[0], [[1.0, 2.0]])
    assert lookahead.own_forecast(1, members, dry)[0].shape == (3, 1)
    with pytest.raises(ConfigurationError, match=r"^/rain: has 3 members, but onoff takes only"):
        onoff.own_forecast(None, members, dry, "/rain")


@pytest.mark.parametrize("count", [0, 1, 5000, 100_000])
def test_times_of_ticks(count: int) -> None:
    """They equal numpy's; for 100,000 ticks the percentile covers the last 65,536."""
    times, drawn = TickTimes(), np.random.default_rng(4).exponential(1e-4, count)
    for seconds in drawn.tolist():
        times.append(seconds)
    statistics = times.statistics(7, 2)
    assert (times.count, statistics["solves"], statistics["fallbacks"]) == (count, 7, 2)
    assert statistics["max_s"] == drawn.max(initial=0)
    assert statistics["mean_s"] == pytest.approx(drawn.mean() if count else 0, rel=1e-9)
    assert statistics["p99_s"] == (np.percentile(drawn[-65_536:], 99) if count else 0)
