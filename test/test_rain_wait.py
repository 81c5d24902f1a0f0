"""The example of a controller that uses the forecast, and the ends of the forecast's steps."""

from __future__ import annotations

from typing import Any

import numpy as np
from paper import PAPER_SITE, paper_run

import greenroof_ros as gr
from examples.rain_wait import RainWait
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.site.site import Site

EXAMPLE = "examples.rain_wait:RainWait"


def made(horizon: float) -> RainWait:
    """Return the example as every part of the package makes it."""
    controller = find_controller(EXAMPLE).make(
        PAPER_SITE, {"horizon": horizon, "command_on": 1.0}
    )
    assert isinstance(controller, RainWait)
    return controller


def test_it_waits_for_exactly_what_is_missing() -> None:
    """Of 10 mm missing on the roof, 10.01 mm of rain within the horizon are enough, 9.99 not."""
    controller = made(3.0)
    lengths = np.diff(controller.forecast_ends)
    assert lengths.sum() == 3 * 3600
    for depth, command in ((9.99, 1.0), (10.01, 0.0)):
        for step in (0, len(lengths) - 1):
            rain = np.zeros(len(lengths))
            rain[step] = depth / 1000 / lengths[step]
            assert controller.command(2.0, 0.0357, rain, rain) == command
    assert controller.command(0.7, 0.0357, np.zeros(len(lengths)), []) == 0.0  # an empty cistern
    # Without a forecast it is on/off.
    for rain in ([], np.full(len(lengths), np.nan)):
        assert [controller.command(2.0, level, rain, []) for level in (0.0456, 0.0458)] == [1, 0]


def test_over_the_papers_window() -> None:
    """Less deviation than on/off, 9611.65, and mpc, 7151.78 m3; without rain it is on/off."""
    waits, on_off = gr.simulate(RainWait), gr.simulate("onoff")
    assert waits.metrics["total_deviation_m3"] < 7151.78
    assert waits.metrics["pumped_m3"] < on_off.metrics["pumped_m3"]
    dry = {"start": "2021-07-07T10:00", "hours": 3}  # no rain until 20 h later
    assert gr.simulate(RainWait, **dry).trajectory.equals(gr.simulate("onoff", **dry).trajectory)


def test_ends_are_set_for_a_class_that_takes_them() -> None:
    """In a run, too; without a horizon they are the next M ticks."""
    assert made(24.0).forecast_ends[-1] == 24 * 3600
    controller = paper_run("--controller", EXAMPLE, "--horizon", "2").make_controller()
    assert controller.forecast_ends[-1] == 2 * 3600  # type: ignore[attr-defined]

    class NextTicks(RainWait):
        parameters = RainWait.parameters[1:]

        def __init__(self, site: Site, command_on: float) -> None:
            super().__init__(site, 0.0, command_on)

        def command(self, *inputs: Any) -> float:
            ends.append(self.forecast_ends.tolist())
            return super().command(*inputs)

    ends = list[list[float]]()
    gr.simulate(NextTicks, hours=0.01, command_on=1.0)
    assert ends[0] == [*range(11)]
