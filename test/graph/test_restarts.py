"""bringup --on-node-failure restart: nodes that die or hang are replaced, and no number changes."""

from __future__ import annotations

import argparse
import math
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from graphs import Process, alive, bring_up, environment, summary_of, wait_for
from rosbags.highlevel import AnyReader

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from greenroof_ros.controllers.decide import decide
from greenroof_ros.experiment.options import (
    add_output_arguments,
    add_run_arguments,
    parse_run_arguments,
    run_from_arguments,
)
from greenroof_ros.graph.serialization import decoder
from greenroof_ros.model.plant import Plant
from greenroof_ros.recording.bag_files import numbered_files
from greenroof_ros.recording.bag_reader import count_ticks
from greenroof_ros.recording.damaged_bag import read_ticks

# Node: module that runs it, of a controller.
MODULES = dict.fromkeys(("mpc", "watched"), "controller")


class Run:
    """A run with restarts whose nodes a test kills."""

    def __init__(self, domain: int, cwd: Path, *arguments: str) -> None:
        self.directory = cwd / "run"
        self.process = Process(
            domain, "bringup", "--output", "run", "--on-node-failure", "restart", *arguments,
            cwd=cwd,
        )

    def reach(self, ticks: int) -> None:
        """Wait until the bag holds some ticks for certain."""

        def reached() -> bool:
            assert self.process.process.poll() is None, self.process.stderr()
            count = 0
            for _, file in numbered_files(self.directory / "bag"):
                count += sum(1 for _ in read_ticks(file, count))
            return count >= ticks

        wait_for(reached, 120, f"{ticks} ticks")

    def pid(self, node: str) -> int:
        """Wait until a node's process is there."""
        pid: int = wait_for(lambda: self.process.nodes().get(MODULES.get(node, node)), 60, node)
        return pid

    def kill(self, node: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Kill a node and wait until there is another process in its place."""
        before = self.pid(node)
        os.kill(before, number)
        wait_for(lambda: self.pid(node) != before, 60, f"another {node}")
        return before

    def goes_on(self, count: int) -> None:
        """Wait until so many nodes have gone on."""
        wait_for(lambda: self.process.stderr().count("goes on") >= count, 60, f"restart {count}")

    def end(self) -> dict[str, Any]:
        """Wait for the good end and return the summary."""
        code = self.process.wait(120)
        assert code == 0, self.process.stderr()
        assert "Traceback" not in self.process.stderr()
        return summary_of(self.directory)

    def bag(self) -> dict[str, list[tuple[int, bytes]]]:
        """Return time and bytes of each message, by topic, as rosbags reads them."""
        found: dict[str, list[tuple[int, bytes]]] = {}
        with AnyReader([self.directory / "bag"]) as reader:
            for connection, time_ns, data in reader.messages():
                found.setdefault(connection.topic, []).append((time_ns, bytes(data)))
        return found


def numbers(bag: dict[str, list[tuple[int, bytes]]], topic: str) -> list[float]:
    """Return the values of a topic of numbers."""
    return [struct.unpack_from("<d", data, 4)[0] for _, data in bag[topic]]


def expected(hours: float, fresh: set[int], controller: str = "mpc") -> dict[str, list[float]]:
    """Work a run out in this process, with another controller from each of some ticks on."""
    parser = argparse.ArgumentParser()
    add_run_arguments(parser)
    add_output_arguments(parser)
    arguments = ["--hours", repr(hours), "--controller", controller]
    run = run_from_arguments(parse_run_arguments(parser, arguments))
    plant, decides = Plant(run.site, run.x1, run.x2), run.make_controller()
    found: dict[str, list[float]] = {
        topic: [] for topic in
        ("/cistern/level", "/roof/level", "/pump/command", "/pump/flow", "/controller/cost")
    }
    for k in range(run.steps + 1):
        if k in fresh:
            decides = run.make_controller()
        levels = plant.levels()
        command = decide(
            decides, not run.series.frost[k], *levels, run.forecast.precipitation(k),
            run.forecast.evapotranspiration(k),
        )
        rain = run.series.precipitation[k]
        pump = plant.pump_flow(command)
        flows = plant.flows(rain, run.series.evapotranspiration[k], pump)
        for topic, value in zip(
            found, (*levels, command, flows.pump, getattr(decides, "cost", math.nan)), strict=True
        ):
            found[topic].append(value)
        plant.step(rain, flows)
    return found


def assert_as_expected(
    run: Run, hours: float, summary: dict[str, Any], controller: str = "mpc"
) -> None:
    """Every number is that of simulate, with a fresh controller from the ticks of the incidents."""
    fresh = {one["tick"] for one in summary["incidents"] if one["node"] == summary["controller"]}
    bag = run.bag()
    lost = [(topic, tick) for one in summary["incidents"] for topic, tick in one["lost"]]
    for topic, values in expected(hours, fresh, controller).items():
        found = numbers(bag, topic)
        for tick in [tick for name, tick in lost if name == topic]:
            assert math.isnan(found[tick])
            found[tick] = values[tick]
        assert found == values, topic
    assert {name for name, _ in lost} <= {"/controller/cost", "/controller/solver_status"}
    times = [time_ns for time_ns, _ in bag["/clock"]]
    assert times == [(1_625_641_200 + tick) * 10**9 for tick in range(len(times))]
    assert all([time_ns for time_ns, _ in each] == times for each in bag.values())
    assert set(summary["messages"].values()) == {len(times)}


def test_killed_one_after_another(domain: int, tmp_path: Path) -> None:
    """kill -9 of weather, controller twice and recorder at random moments of one run."""
    chance = random.Random(11)
    hours = 0.4
    run = Run(domain, tmp_path, "--hours", repr(hours), "--speed", "100")
    for count, node in enumerate(("weather", "mpc", "recorder", "mpc"), 1):
        run.reach(100 * count)
        time.sleep(chance.uniform(0, 0.5))
        run.kill(node)
        run.goes_on(count)
    summary = run.end()
    assert [one["node"] for one in summary["incidents"]] == ["weather", "mpc", "recorder", "mpc"]
    ticks = [one["tick"] for one in summary["incidents"]]
    assert sorted(set(ticks)) == ticks
    for one in summary["incidents"]:
        assert one["how"] == "SIGKILL"
        assert one["restarted_after_s"] > 0
    assert_as_expected(run, hours, summary)
    # It is not for nothing that the controllers are fresh ones.
    assert expected(hours, {ticks[1], ticks[3]}) != expected(hours, set())
    assert run.process.stdout().count("RESTARTED") == 4
    bag = run.directory / "bag"
    assert {file.name for file in bag.iterdir()} == {"bag_0.mcap", "bag_1.mcap", "metadata.yaml"}
    assert count_ticks(bag) == 1441
    for command in (("report", "run", "--output", "page"), ("recover", "run")):
        done = subprocess.run(
            [sys.executable, "-m", f"greenroof_ros.{command[0]}", *command[1:]], cwd=tmp_path,
            env=environment(domain), capture_output=True, text=True, check=False,
        )
        assert done.returncode == 0, done.stderr
    assert f"another went on from tick {ticks[2]}" in next(
        (tmp_path / "page").glob("*.html")
    ).read_text()
    # Recovered into one file it has the same messages.
    before = run.bag()
    shutil.rmtree(bag)
    (run.directory / "bag-recovered").rename(bag)
    assert run.bag() == before


def test_killed_at_the_start_and_together(domain: int, tmp_path: Path) -> None:
    """All but the plant are killed as soon as they are there, and in the run at once.

    Nothing of it is seen in the bag: on/off control has no memory.
    """
    hours = 0.2
    bring_up(domain, tmp_path, "--hours", repr(hours), "--controller", "onoff", output="whole")
    run = Run(domain, tmp_path, "--hours", repr(hours), "--controller", "onoff", "--speed", "100")
    for node in ("weather", "mpc", "recorder", "recorder"):
        run.kill(node)  # the recorder's second process before it can have gone on
    run.goes_on(3)
    run.reach(300)
    for node in ("recorder", "weather", "mpc"):
        os.kill(run.pid(node), signal.SIGKILL)
    summary = run.end()
    assert [one["tick"] for one in summary["incidents"][:4]] == [0, 0, None, 0]
    assert len(summary["incidents"]) == 7
    assert "another process ended before" in " ".join(
        run.process.stdout().replace("│", " ").split()
    )
    whole = Run.__new__(Run)
    whole.directory = tmp_path / "whole"
    assert run.bag() == whole.bag()


WATCHED = """
from pathlib import Path
from greenroof_ros.controllers.mpc import Mpc

class Watched(Mpc):
    def command(self, *inputs):
        Path("decided").touch()
        return super().command(*inputs)
"""


def test_killed_in_a_pause(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One tick lasts 1 s: nodes end long after they have answered, and answer no tick twice.

    The weather hangs, is killed by bringup after its limit, and is replaced likewise. The run is
    long enough for slow machines.
    """
    (tmp_path / "watched.py").write_text(WATCHED)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)  # this process has a Watched of its own decide, too
    hours, controller = 24 / 3600, "watched:Watched"
    run = Run(
        domain, tmp_path, "--hours", repr(hours), "--speed", "1", "--peer-limit", "5",
        "--controller", controller,
    )
    wait_for((tmp_path / "decided").exists, 60, "the first tick")
    time.sleep(1.5)
    run.kill("watched")
    run.goes_on(1)
    time.sleep(2.5)
    run.kill("recorder")
    run.goes_on(2)
    # ROS repeats nodes' names every 3 s: the recorder must know that of the one that is killed.
    time.sleep(4)
    run.kill("weather", signal.SIGSTOP)
    summary = run.end()
    controllers, recorders, weathers = summary["incidents"]
    assert [one["node"] for one in summary["incidents"]] == ["watched", "recorder", "weather"]
    assert weathers["how"] == "stopped, silent for 5 s"
    # Not one whole chunk was written, but what a node that was killed has said is safe. A weather
    # that comes after the recorder may have to say again what the recorder lacks.
    assert 0 < controllers["tick"] <= recorders["tick"] <= weathers["tick"] <= 24
    assert_as_expected(run, hours, summary, controller)


FRAGILE = '''
import os, signal
from pathlib import Path
import numpy as np

class Fragile:
    """Commands 0.001, 0.002 and so on; its first process kills itself at the tenth tick."""
    parameters = ()
    outputs = {"/controller/cost": "cost", "/controller/solver_status": "status",
               "/controller/plan": "plan"}
    status = 1
    plan = np.empty((0, 3))
    def __init__(self, site):
        self.ticks = 0
    def command(self, cistern, roof, rain, evapotranspiration):
        self.ticks += 1
        self.die("before")
        return self.ticks / 1000
    def skip(self):
        pass
    def statistics(self):
        return None
    @property
    def cost(self):
        self.die("between")
        return 2.0 * self.ticks
    def die(self, when):
        if self.ticks == 10 and when == os.environ["DIES"] and not Path("died").exists():
            Path("died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
'''


@pytest.mark.parametrize("when", ["before", "between"])
def test_killed_between_two_messages(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """A controller that dies before its command, or between that and what it says beside it.

    The command that the plant was given stands; what was lost is NaN in the bag, and is named.
    """
    (tmp_path / "fragile.py").write_text(FRAGILE)
    monkeypatch.setenv("DIES", when)
    run = Run(domain, tmp_path, "--hours", repr(29 / 3600), "--controller", "fragile:Fragile")
    summary = run.end()
    (incident,) = summary["incidents"]
    bag = run.bag()
    decode = decoder("std_msgs/msg/Float64MultiArray")
    commands, costs = numbers(bag, "/pump/command"), numbers(bag, "/controller/cost")
    if when == "before":
        assert (incident["tick"], incident["lost"]) == (9, [])
        ticks = [*range(1, 10), *range(1, 22)]
        assert costs == [2.0 * tick for tick in ticks]
    else:
        assert (incident["tick"], incident["lost"]) == (
            10,
            [["/controller/cost", 9], ["/controller/solver_status", 9], ["/controller/plan", 9]],
        )
        ticks = [*range(1, 11), *range(1, 21)]
        assert math.isnan(costs.pop(9))
        assert costs == [2.0 * tick for tick in [*ticks[:9], *ticks[10:]]]
        assert numbers(bag, "/controller/solver_status") == [1.0] * 9 + [0.0] + [1.0] * 20
        plans = [decode(data) for _, data in bag["/controller/plan"]]
        assert [len(plan) for plan in plans] == [0] * 9 + [3] + [0] * 20
        assert all(map(math.isnan, plans[9]))
    assert commands == [tick / 1000 for tick in ticks]
    assert {len(each) for each in bag.values()} == {30}


DYING_WEATHER = """
import os, signal, sys
from pathlib import Path
if any(word.endswith("nodes.weather") for word in sys.orig_argv) and not Path("died").exists():
    from greenroof_ros.weather.series import WeatherSeries
    class Dying:
        def __init__(self, hour):
            self.hour = hour
        def __getattr__(self, name):
            if name == "precipitation":
                Path("died").touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return getattr(self.hour, name)
    at = WeatherSeries.at
    def dying(self, tick):
        hour = at(self, tick)
        by = sys._getframe(1).f_code.co_name
        return Dying(hour) if by == "on_inputs" and tick == 20 else hour
    WeatherSeries.at = dying
"""


def test_weather_killed_between_two_messages(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The controller has the forecast of a tick, the plant has no rain: the new one says both."""
    bring_up(domain, tmp_path, "--hours", "0.01", output="whole")
    (tmp_path / "sitecustomize.py").write_text(DYING_WEATHER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    run = Run(domain, tmp_path, "--hours", "0.01")
    summary = run.end()
    (incident,) = summary["incidents"]
    # The new one says again what the recorder lacks, which may be slower than the tick.
    assert incident["node"] == "weather" and incident["tick"] <= 20
    whole = Run.__new__(Run)
    whole.directory = tmp_path / "whole"
    assert run.bag() == whole.bag()


def test_end_of_the_plant_ends_the_run(domain: int, tmp_path: Path) -> None:
    """Its state dies with it."""
    run = Run(domain, tmp_path)
    run.reach(100)
    nodes = run.process.nodes()
    os.kill(nodes["plant"], signal.SIGKILL)
    assert run.process.wait(300) == 1
    summary = summary_of(run.directory)
    assert (summary["reason"], summary["incidents"]) == ("node plant ended (SIGKILL)", [])
    assert not [name for name, pid in nodes.items() if alive(pid)]


def test_no_node_is_started_again_for_ever(domain: int, tmp_path: Path) -> None:
    """Five times; the sixth death ends the run as the first does without the option."""
    run = Run(domain, tmp_path)
    for _ in range(5):
        run.kill("weather")
    os.kill(run.pid("weather"), signal.SIGKILL)
    assert run.process.wait(300) == 1
    summary = summary_of(run.directory)
    assert summary["reason"] == "node weather ended (SIGKILL)"
    assert [one["node"] for one in summary["incidents"]] == ["weather"] * 5


def test_what_says_why_it_ends_is_not_started_again(domain: int, tmp_path: Path) -> None:
    """A controller whose command is none says so, and would again."""
    (tmp_path / "fragile.py").write_text(FRAGILE.replace("self.ticks / 1000", "-1.0"))
    os.environ["DIES"] = "never"
    try:
        run = Run(domain, tmp_path, "--controller", "fragile:Fragile")
        assert run.process.wait(300) != 0
    finally:
        del os.environ["DIES"]
    summary = summary_of(run.directory)
    assert "must be a finite number, not negative" in summary["reason"]
    assert summary["incidents"] == []
