"""Live sites and pump nodes as processes, with simulated drives, tanks and sensors."""

from __future__ import annotations

import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

from graphs import Process, alive, free_ports, wait_for
from places import CONFIG, guarding
from ros_rig import LATE, Observer, Site, write_forecast
from simulators import Simulator
from std_msgs.msg import String

from greenroof_ros.interface.states import ActuatorState

QUICK = "/**:\n  ros__parameters:\n    recovery_time: 1.0\n"


@contextmanager
def live(
    domain: int, cwd: Path, *arguments: str, code: int = 0, stderr: int | None = None
) -> Iterator[Process]:
    """Bring up a site; on request it must end as expected, together with all of its nodes."""
    words = "live.live_site", "--state", "run", *arguments
    process = Process(domain, *words, cwd=cwd, stderr=stderr)
    yield process
    nodes = process.nodes().values()
    process.process.send_signal(signal.SIGTERM)
    assert process.wait(300) == code, process.stderr()
    assert not any(map(alive, nodes))
    assert "Traceback" not in process.stderr()


class Hardware(Simulator):
    """A drive and, on request, tanks with level sensors, simulated by programs."""

    def __init__(self, domain: int, cwd: Path) -> None:
        super().__init__(
            "drive_simulator", "--drive", "abb_acs880", "--ramp", "1", "--port", "0",
            "--workbench", "0",
        )
        self.domain, self.cwd, self.file = domain, cwd, guarding("abb_acs880", cwd)

    def be_a_site(self) -> tuple[str, ...]:
        """Return bringup's options for a site without sensors and with an old forecast."""
        cistern, roof = free_ports(2)
        text = (CONFIG / "sensors.yaml").read_text()
        (self.cwd / "sensors.yaml").write_text(
            text.replace(":5030", f":{cistern}").replace(":5031", f":{roof}")
            .replace("period: 1.0", "period: 0.5")
        )
        write_forecast(self.cwd / "forecast.csv", timedelta(days=2000), 0.0, 12.0)
        (self.cwd / "nodes.yaml").write_text(f"{QUICK}    min_off: 1.0\n")
        return (
            "--controller", "onoff", "--sensors", "sensors.yaml", "--forecast", "forecast.csv",
            "--drive", self.file, "--drive-at", self.address, "--node-parameters", "nodes.yaml",
        )

    def begin(self) -> None:
        """Fill the tanks, start the sensors, and write a forecast."""
        tanks = Process(
            self.domain, "site_simulator", "--sensors", "sensors.yaml", "--drive-at",
            self.workbench, "--workbench", "0", "--initial", "high-low", cwd=self.cwd,
        )
        wait_for(tanks.stdout, 60, "sensors that are ready")
        write_forecast(self.cwd / "forecast.csv", timedelta(minutes=5), 0.0, 12.0)

    def speed(self) -> float:
        """Return the pump's true speed (share of rated); each call takes 0.1 s."""
        time.sleep(0.1)
        return super().speed()

    def until_it_pumps(self) -> None:
        wait_for(lambda: self.speed() > 0.9, 90, "the pump")


def state_in(message: String) -> str:
    """Return the pump's state and the reason in a message of /pump/state."""
    return str(ActuatorState.read(message.data))


class PumpRig(Site):
    """The node's peers: they send levels, frost and commands, and record its answers."""

    def __init__(self, observer: Observer) -> None:
        super().__init__(observer)
        self._drive: Simulator | None = None
        self.flows: list[float] = observer.collect("/pump/flow")
        self._flow_times = observer.times("/pump/flow")
        self.states: list[str] = observer.collect("/pump/state", state_in)
        self.values = {
            "/cistern/level": lambda _: 3.0 - self.pumped() / 25.0,
            "/roof/level": lambda _: (0.3 + self.pumped()) / 68.8,
            "/weather/frost": 0.0, "/pump/command": 0.5,
        }

    @property
    def drive(self) -> Simulator:
        """Return the drive; start it if necessary."""
        return self._drive or self.simulate()

    def simulate(self, port: int = 0) -> Simulator:
        """Start the simulated drive, ten times as fast as in real time, until the test's end."""
        self._drive = Simulator(
            "drive_simulator", "--drive", "abb_acs880", "--speed", "10", "--boot", "0.1",
            "--timeout", "1.5", "--port", str(port),
        )
        self.watcher.started.append(self._drive.process)
        return self._drive

    def code(self, part: str) -> str:
        """Return the condition code of a part of the node; empty if the part is well."""
        return str(self.watcher.values(f"/pump: {part}").get("code", ""))

    def start(
        self, address: str = "", *, popen: dict[str, Any] | None = None, **parameters: object,
    ) -> subprocess.Popen[Any]:
        """Start the node, by default with the simulated drive; its state file is kept."""
        settings = {
            "drive": guarding("abb_acs880", self.cwd),
            "address": address or self.drive.address,
            "site_file": parameters.get("site_file") or self.site(), "recovery_time": 0.3,
            "state_file": self.cwd / "state.json", "min_on": 1.0, "min_off": 1.0, **parameters,
        }
        self.states.clear()
        return self.watcher.start("live.pump", popen=popen, **settings)

    def site(self, *lines: str) -> Path:
        """Write a site file with a short tau and further lines, and return it."""
        file = self.cwd / "site.yaml"
        text = [f"extends: {CONFIG / 'site.yaml'}", "starts_per_hour: 3600", "tau: 0.1", *lines]
        file.write_text("\n".join(text))
        return file

    @property
    def state(self) -> str:
        return self.states[-1] if self.states else ""

    def pumped(self) -> float:
        """Return the volume that the flows so far have delivered (m3)."""
        return sum(
            flow * (after - before)
            for flow, (before, after) in zip(self.flows, pairwise(self._flow_times), strict=False)
        )

    def command(self, command: float, condition: Callable[[], Any], event: str) -> None:
        """Command until a condition holds."""
        self.values["/pump/command"] = command
        self.until(condition, LATE, f"{event} ({self.states[-3:]})")

    def until_at_rest(self, command: float = 0.5) -> None:
        """Command until the motor stands and flow is 0."""
        self.command(
            command, lambda: self.drive.speed() == 0.0 and self.flows[-1] == 0.0, "a stop"
        )

    def run(self) -> None:
        """Command until the pump runs."""
        self.command(
            0.5, lambda: self.state.startswith("running") and self.drive.speed() > 0.5, "running"
        )

    def stays_off(self, state: str) -> None:
        """Check that the node does not run the pump, in a state with a reason, as a pattern."""
        self.command(0.5, lambda: re.match(state, self.state) and self.flows[-1] == 0.0, state)
        before = len(self.flows)
        self.during(1.0)
        assert {*self.flows[before:]} <= {0.0} and re.match(state, self.state), self.state

    def finish(self, process: Process) -> tuple[int, str]:
        """Command 0 until a command has ended; return its exit code and its output."""
        self.command(0.0, lambda: process.process.poll() is not None, "the end of a command")
        return process.wait(1), process.stdout() + process.stderr()
