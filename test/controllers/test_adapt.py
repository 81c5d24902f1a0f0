"""What a class may leave out, or ask for, with what it then receives."""

from __future__ import annotations

import subprocess
import sys
import warnings
from array import array
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from paper import VALVE
from refusals import refusal

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


class Both(Told):
    outlet = 0.0

    def command(self, cistern, roof, rain: np.ndarray, evaporated: np.ndarray):
        return 0.5, 0.25


class Pair(Told):
    def command(self, cistern, roof, rain: np.ndarray, evaporated: np.ndarray):
        return 0.5, 0.25


def simulate(kind: Any, **inputs: Any) -> list[str]:
    """Simulate a minute, and return the warnings."""
    with warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        gr.simulate(kind, hours=1 / 60, **inputs)
    return [str(each.message) for each in noted]


def test_a_class_of_today_receives_what_it_did_and_a_note() -> None:
    (note,) = simulate(Today)
    assert note.startswith("Today.command() receives its forecasts as array.array, with which 2 *")
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


def test_a_class_may_return_both_commands() -> None:
    """If it commands the valve."""
    site = gr.read_site(**VALVE)
    ticks = gr.simulate(Both, site=site, hours=0.1).ticks
    assert {*ticks.outlet} == {0.25} and {*ticks.command} == {0.5}
    refusal(lambda: gr.simulate(Pair, hours=0.1), match="command of Pair = .0.5, 0.25.: must be")


def test_a_function_may_return_both_commands() -> None:
    """None leaves the valve to its policy."""
    site = gr.read_site(**VALVE)
    ticks = gr.simulate(lambda state, forecast: (0.5, 0.25), site=site, hours=0.1).ticks
    assert {*ticks.outlet} == {0.25} and {*ticks.command} == {0.5}
    inputs = {"site": site, "start": "2021-07-07T12:00", "hours": 1, "outlet": "drain"}
    alone, none = (
        gr.simulate(lambda state, forecast, given=given: given, **inputs).ticks
        for given in (0.5, (0.5, None))
    )
    assert alone.outlet.tolist() == none.outlet.tolist() and alone.outlet.any()
    for given, reason in (
        ((0.5, 1.5), "the opening of the valve of lambda = 1.5: must be a number from 0 to 1"),
        ((1.5, 0.5), "the command of lambda = 1.5: must be a number from 0 to 1"),
    ):
        refusal(
            lambda given=given: gr.simulate(lambda state, forecast: given, **inputs), match=reason
        )
    refusal(
        lambda: gr.simulate(lambda state, forecast: (0.5, 0.5), hours=0.1),
        match="outlet = 0.5: needs a site with a valve",
    )


@pytest.mark.parametrize("name", ["Arrays", "Both", "Today", "Timed"])
def test_the_checks_of_a_class_pass(name: str) -> None:
    site = gr.read_site(**VALVE) if name == "Both" else gr.read_site()
    assert not any(check_controller(find_controller(f"test_adapt:{name}"), site).values())


def test_check_controller_takes_a_site_with_a_valve(tmp_path: Any) -> None:
    """For a class that needs one."""
    (tmp_path / "needs.py").write_text(
        "class Needs:\n"
        "    parameters = ()\n"
        "    outlet = 0.0\n"
        "    def __init__(self, site):\n"
        "        assert site.low_outlet_valve\n"
        "    def command(self, cistern, roof, rain, evaporated):\n"
        "        return 0.0, 1.0\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "check-controller", "needs:Needs"], cwd=tmp_path,
        capture_output=True, text=True,
    )
    assert done.returncode == 0 and "12 of 12 checks passed" in done.stdout, done.stderr
