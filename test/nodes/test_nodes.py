"""Nodes by hand: what is refused, a middleware that locks up, peers that are awaited or gone."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from commands import run_command
from graphs import Process, bag_file, environment, udp_addresses_of, wait_for
from mcap.reader import make_reader
from places import CONFIG
from ros_rig import Observer, ros_arguments

from greenroof_ros.ros.domain import LEASE


def test_middleware_that_locks_up_at_the_end(domain: int, tmp_path: Path) -> None:
    """Even if the teardown hangs and no Python can run, the node ends."""
    hangs = (
        "import ctypes; from rclpy.node import Node; from greenroof_ros.nodes.weather import main; "
        "Node.destroy_node = lambda node: ctypes.PyDLL(None).sleep(60); main()"
    )
    process = subprocess.Popen([sys.executable, "-c", hangs], cwd=tmp_path, env=environment(domain))
    wait_for(lambda: udp_addresses_of(process.pid), 60, "the start of the node")
    process.send_signal(signal.SIGINT)
    assert process.wait(300) == -signal.SIGALRM


DRIVE = "--ros-args -p drive:=abb_acs880 -p address:=tcp://127.0.0.1:1"
# What the last line names, by command; the sites and sensors are made below.
REFUSED = {
    "nodes.controller --controller mpc --ros-args -p weight:=-1.0": "weight of mpc = -1.0: ",
    "nodes.plant --ros-args --params-file wrong.yaml":
        "wrong.yaml, line 2: parameter run_lenght of plant = 4: ",
    "nodes.recorder --ros-args -p directory:=.": ": exists, but ",
    # A level counts for 5 s (level_limit), which must cover two readings.
    "live.station --sensors sensors.yaml": "line 22: cistern.period = 2.6: ",
    "live.station --sensors sensors_mqtt.yaml --ros-args -p level_limit:=4.0":
        "line 16: cistern.max_age = 5.0: ",
    f"live.pump {DRIVE} -p folow_time:=9.0": "folow_time of pump = '9.0': ",
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_is_refused(domain: int, tmp_path: Path, command: str) -> None:
    """Exit code 2 and one clear line: a supervisor need not restart it."""
    for file in ("sensors.yaml", "sensors_mqtt.yaml"):
        text = (CONFIG / file).read_text().replace("period: 1.0", "period: 2.6")
        (tmp_path / file).write_text(text)
    (tmp_path / "wrong.yaml").write_text("/**/plant:\n  ros__parameters: {run_lenght: 4}\n")
    done = run_command(*command.split(), cwd=tmp_path, env=environment(domain))
    assert done.returncode == 2 and "Traceback" not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert "error: " in line and REFUSED[command] in line


@pytest.fixture
def start(domain: int, tmp_path: Path) -> Callable[..., Process]:
    """Return a function that starts a node by hand; a controller by its own name."""

    def start(name: str, **parameters: object) -> Process:
        which = ["controller", "--controller", name] if name in ("mpc", "onoff") else [name]
        return Process(
            domain, f"nodes.{which[0]}", *which[1:], *ros_arguments(**parameters), cwd=tmp_path
        )

    return start


def end(node: Process) -> tuple[int, str]:
    """Wait until a node ends on its own, and return its exit code and its error."""
    code = node.wait(300)
    error = "".join(line for line in node.stderr().splitlines() if line.startswith("error: "))
    # If the middleware is slow to end, the kernel ends the node, which has printed everything.
    return int(bool(error)) if code == -signal.SIGALRM else code, error


def test_started_by_hand_gives_the_bag_of_bringup(
    tmp_path: Path, start: Callable[..., Process], recorded: Path
) -> None:
    """Equal in every byte; each node starts while the others wait for it, and ends with 0."""
    nodes = [
        start("weather", run_length=360), start("recorder", directory="bag", controller="mpc"),
        start("plant", run_length=360, record="true"), start("mpc"),
    ]
    assert {end(node) for node in nodes} == {(0, "")}
    assert (tmp_path / "bag/bag_0.mcap").read_bytes() == bag_file(recorded).read_bytes()


def test_a_node_that_is_killed_is_named(
    start: Callable[..., Process], observer: Observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the plant: the weather, not the controller that waits for the weather's forecast.

    Without a plant, the others end, and the bag is closed. ROS drops a node after 6 s, not 20.
    """
    monkeypatch.setenv(LEASE, "6")
    flows = observer.collect("/pump/flow")
    weather, *others = (
        start("weather"), start("onoff"),
        start("recorder", directory="bag", controller="onoff"),
    )
    plant = start("plant", run_length=40_000, record="true", speed=500.0, peer_limit=2.0)
    observer.until(lambda: len(flows) >= 50, 60, "50 ticks")
    weather.process.kill()
    code, error = end(plant)
    # The kill can come between the two messages of a tick.
    assert code == 1 and re.search(
        "no message within 2 s on (/weather/precipitation, )?/weather/evapotranspiration from "
        "weather$", error,
    ), error
    for other in others:
        code, error = end(other)
        assert code == 1 and "the plant has stopped" in error
    with (observer.cwd / "bag/bag_0.mcap").open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None
