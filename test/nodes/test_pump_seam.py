"""A pump driver that knows nothing of this package takes the simulated pump's place."""

from __future__ import annotations

import math
import re
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import Process, bag_file, bring_up, environment, wait_for
from mcap.reader import make_reader
from places import CHECKOUT

DRIVER = CHECKOUT / "examples" / "pump_driver.py"
# Table I of the paper.
A1, A2, A_IN = 25.0, 68.8, 0.305**2 * math.pi

# With rclpy's own settings.
DEFAULT_DRIVER = """
import rclpy
from std_msgs.msg import Float64

rclpy.init()
node = rclpy.create_node("pump")
publisher = node.create_publisher(Float64, "/pump/flow", 10)
node.create_subscription(Float64, "/pump/command", publisher.publish, 10)
rclpy.spin(node)
"""


def values(run: Path, topic: str) -> list[float]:
    """Return a topic's values."""
    with bag_file(run).open("rb") as stream:
        return [
            struct.unpack_from("<d", message.data, 4)[0]
            for _, _, message in make_reader(stream).iter_messages(topics=[topic])
        ]


def test_example_driver(domain: int, tmp_path: Path) -> None:
    """A thousand ticks through examples/pump_driver.py, with a lag: the levels follow its flow."""
    source = DRIVER.read_text()
    assert "greenroof" not in source
    code = source.split('"""', 2)[2]
    assert len([line for line in code.splitlines() if line.strip()]) <= 48
    driver = subprocess.Popen(
        [sys.executable, str(DRIVER)], cwd=tmp_path, env=environment(domain),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )
    try:
        bring_up(
            domain, tmp_path, "--pump", "external", "--controller", "onoff", "--fraction", "2",
            "--hours", str(1000 / 3600),
        )
        # The controller is gone: the driver has stopped its pump and says so.
        assert wait_for(lambda: driver.poll() is not None, 60, "the driver's end")
        assert driver.communicate() == ("stopped: no controller\n", "")
        assert driver.returncode == 0
    finally:
        if driver.poll() is None:
            driver.send_signal(signal.SIGINT)
            driver.wait(300)
    run = tmp_path / "run"
    commands, flows = values(run, "/pump/command"), values(run, "/pump/flow")
    assert len(flows) == 1001
    # Its flow: a first-order lag behind its maximum flow times the command, clamped at 1.
    constants = re.search(r"^MAX_FLOW, LAG, TICK = ([\d., ]+)", source, re.MULTILINE)
    assert constants
    maximum, lag, tick = map(float, constants[1].split(","))
    flow = 0.0
    # It is off until levels and frost have come, behind the first commands: how many pass until
    # they are discovered is a matter of the machine, and 300 ticks are a second.
    told = next(tick for tick, measured in enumerate(flows) if measured)
    assert told < 500
    for command, measured in zip(commands[told:], flows[told:], strict=True):
        flow += (min(command, 1.0) * maximum - flow) * (1 - math.exp(-tick / lag))
        assert measured == pytest.approx(flow, rel=1e-12, abs=1e-300)
    assert max(commands) == 2.0
    assert 0.5 * maximum < max(flows) < maximum
    # The levels: the mass balance with that flow, and not with the simulated pump's.
    cistern, roof = values(run, "/cistern/level"), values(run, "/roof/level")
    rain = values(run, "/weather/precipitation")
    evapotranspiration = values(run, "/weather/evapotranspiration")
    outflow, drainage = values(run, "/cistern/outflow"), values(run, "/roof/drainage")
    for k in range(1000):
        into_cistern = rain[k] * A_IN - outflow[k] - flows[k]
        into_roof = rain[k] * A2 + flows[k] - evapotranspiration[k] - drainage[k]
        assert cistern[k + 1] * A1 == pytest.approx(cistern[k] * A1 + into_cistern, abs=1e-9)
        assert roof[k + 1] * A2 == pytest.approx(roof[k] * A2 + into_roof, abs=1e-9)
    assert roof[1000] > 0.0457  # it kept flowing for a while after the command fell to 0


def test_publisher_that_does_not_fit_is_named_at_once(domain: int, tmp_path: Path) -> None:
    """One line on the console and in the log: who, what it is, and all that it must be."""
    logs = tmp_path / "run" / "log"
    driver = subprocess.Popen(
        [sys.executable, "-c", DEFAULT_DRIVER], cwd=tmp_path, env=environment(domain),
        stderr=subprocess.DEVNULL,
    )
    try:
        process = Process(domain, "bringup", "--pump", "external", "--output", "run", cwd=tmp_path)
        wait_for(lambda: "warning" in process.stderr(), 60, "a warning")
        warning = (
            "/pump/flow has a publisher that cannot be heard (pump): it is volatile and has no "
            "liveliness lease, and must be reliable, transient local, keep last 64, with a "
            "liveliness lease of 1 s (doc/real-pump.md); change it, or end it"
        )
        log = logs / "plant.log"
        wait_for(lambda: log.exists() and warning in log.read_text(), 60, "the log")
        process.process.terminate()
        assert process.wait(300) == 130
    finally:
        driver.kill()
        driver.wait(300)
    warnings = [line for line in process.stderr().splitlines() if "warning" in line]
    assert warnings == [f"warning: {warning}"]
    assert not any("Last incompatible policy" in log.read_text() for log in logs.iterdir())
