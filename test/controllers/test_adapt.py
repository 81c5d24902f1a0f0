"""What a class may leave out, or ask for, with what it then receives."""

from __future__ import annotations

import warnings
from array import array
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import VALVE
from places import refusal

import greenroof_ros as gr
from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import find_controller


class Told:
    """Notes what it receives; without skip and statistics."""

    parameters = (gr.Parameter("horizon", 3.0, "h", 0.1, 240.0, "length of the forecast"),)
    seen: list[Any] = []  # noqa: RUF012

    def __init__(self, site: Any, horizon: float) -> None:
        self.seen.clear()


class Today(Told):
    def command(self, cistern, roof, rain, evaporated):
        self.seen.append((rain, evaporated))
        return 0.0


class Arrays(Told):
    def command(self, cistern, roof, rain: NDArray[np.float64], evaporated: np.ndarray) -> float:
        self.seen.append((rain * 2, evaporated))
        return 0.0


class Timed(Told):
    def command(self, cistern, roof, rain: "Unknown", evaporated: "np.ndarray", time) -> float:  # noqa: F821, UP037
        self.seen.append(time)
        return 0.0


class Pair(Told):
    def command(self, cistern, roof, rain: np.ndarray, evaporated: np.ndarray):
        return 0.5, 0.25


class Both(Pair):
    outlet = 0.0


def simulate(kind: Any, **inputs: Any) -> list[str]:
    """Simulate a minute, and return the warnings."""
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        gr.simulate(kind, hours=1 / 60, **inputs)
    return [str(each.message) for each in noted]


def test_a_class_of_today_receives_what_it_did_and_a_note() -> None:
    assert len(simulate(Today)) == 1
    assert all(type(each) is array for pair in Today.seen for each in pair)


def test_annotated_arrays_are_numpys() -> None:
    """Of which * is a product."""
    assert simulate(Arrays) == []
    for rain, evaporated in Arrays.seen:
        assert type(rain) is type(evaporated) is np.ndarray and len(rain) == len(evaporated)


def test_the_time_in_the_sites_zone() -> None:
    """The paper's window begins at 02:00-05:00; also in quiet hours, in which it is asked, too."""
    assert simulate(Timed) == []
    assert [each.isoformat() for each in Timed.seen[:2]] == [
        "2021-07-07T02:00:00-05:00", "2021-07-07T02:00:01-05:00",
    ]
    site = gr.read_site(time_zone="America/Toronto", quiet_hours=["00:00-12:00"])
    assert simulate(Timed, site=site, start="2021-07-07T02:00-05:00") == []
    assert len(Timed.seen) == 61
    assert Timed.seen[0].isoformat() == "2021-07-07T03:00:00-04:00"


def test_a_controller_may_return_both_commands() -> None:
    """A class if it commands the valve; of a function, None leaves the valve to its policy."""
    inputs = {"site": gr.read_site(**VALVE), "start": "2021-07-07T12:00", "hours": 1}
    for kind in (Both, lambda state, forecast: (0.5, 0.25)):
        ticks = gr.simulate(kind, **inputs).ticks
        assert {*ticks.outlet} == {0.25} and {*ticks.command} == {0.5}
    alone, none = (
        gr.simulate(lambda state, forecast, given=given: given, outlet="drain", **inputs).ticks
        for given in (0.5, (0.5, None))
    )
    assert alone.outlet.tolist() == none.outlet.tolist() and alone.outlet.any()
    refusal(lambda: gr.simulate(Pair, **inputs), match="command of Pair")
    too_far = "the opening of the valve of lambda = 1.5"
    refusal(lambda: gr.simulate(lambda state, forecast: (0.5, 1.5), **inputs), match=too_far)
    refusal(lambda: gr.simulate(lambda state, forecast: (0.5, 0.5), hours=0.1), match="outlet")


@pytest.mark.parametrize("name", ["Arrays", "Both", "Today", "Timed"])
def test_the_checks_of_a_class_pass(name: str) -> None:
    site = gr.read_site(**VALVE) if name == "Both" else gr.read_site()
    assert not any(check_controller(find_controller(f"test_adapt:{name}"), site).values())
