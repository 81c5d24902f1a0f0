"""Environments that are copied, and simulations in threads and in forked processes."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from paper import VALVE

import greenroof_ros as gr

INPUTS: tuple[dict[str, Any], ...] = (
    {}, {"forecast": "errors"}, {"forecast": "ensemble", "forecast_members": 3},
    {"roof_noise": 0.002, "pump_min_on": 120.0, "pump_min_off": 60.0},
    {"site": gr.read_site(**VALVE), "outlet": "plan", "forecast": "errors"},
)


@pytest.mark.parametrize("inputs", INPUTS)
@pytest.mark.parametrize("copied", [
    copy.deepcopy, lambda roof: pickle.loads(pickle.dumps(roof))
])
def test_a_copy_goes_on_from_the_same_tick(
    copied: Callable[[Any], Any], inputs: dict[str, Any]
) -> None:
    roof, chance = gr.Environment(hours=0.2, **inputs), np.random.default_rng(1)
    for _ in range(300):
        roof.step(float(chance.random() > 0.5))
    commands, results = chance.random(420), []
    for each in (copied(roof), roof):
        ticks = [(repr(each.step(command)), each.forecast.rain.tobytes()) for command in commands]
        results.append((ticks, each.state, each.metrics, each.done))
    assert results[0] == results[1]
    assert results[0][-1]


def deviation(number: int) -> float:
    site = gr.read_site(z_veg=0.03 + 1e-5 * number)
    name = "mpc" if number % 2 else "onoff"
    return gr.simulate(name, hours=0.01, site=site).metrics["total_deviation_m3"]


@pytest.mark.filterwarnings("ignore")
def test_threads_give_what_one_gives() -> None:
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(deviation, range(40))) == list(map(deviation, range(40)))


def test_a_fork_simulates_but_makes_no_data_frame() -> None:
    """In a process of its own, as polars would wait in it for ever."""
    program = """
import os, warnings
import greenroof_ros as gr
warnings.simplefilter("ignore")
gr.simulate("onoff", hours=0.1).trajectory.sort("time")
child = os.fork()
if child == 0:
    result = gr.simulate("mpc", hours=0.01)
    try:
        result.trajectory
    except Exception as error:
        print(result.metrics["pump_starts"], error, flush=True)
    os._exit(0)
os.waitpid(child, 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], env=dict(os.environ), capture_output=True, text=True,
        check=True, timeout=120,
    )
    assert "1 a data frame: cannot be created" in done.stdout and "spawn" in done.stdout
