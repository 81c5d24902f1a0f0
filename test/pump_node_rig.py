"""A pump node and a simulated drive as processes; the test acts as sensors and controller."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

from graphs import wait_for
from places import CONFIG, guarding
from ros_rig import LATE, Observer
from simulators import Simulator
from std_msgs.msg import Float64, String

from greenroof_ros.interface.states import ActuatorState

# The node's tau, and a drive that ramps ten times as fast as in real time.
PERIOD_S = 0.1
PACE = ("--speed", "10", "--boot", "0.1", "--timeout", "1.5")
MIN_TIMES = {"min_on": 1.0, "min_off": 1.0}


def state_in(message: String) -> str:
    """Return the pump's state and the reason in a message of /pump/state."""
    return str(ActuatorState.read(message.data))


class PumpRig:
    """The node's peers: they send levels, frost and commands, and record its answers."""

    def __init__(self, observer: Observer) -> None:
        self.domain, self.cwd, self.observer = observer.domain, observer.cwd, observer
        self._drive: Simulator | None = None
        self.node = observer.node
        self.flows: list[float] = observer.collect("/pump/flow")
        self._flow_times = observer.times("/pump/flow")
        self._command = 0.0
        self.states: list[str] = observer.collect("/pump/state", state_in)
        self._volumes = [75.0, 0.3]
        self._publishers: dict[str, Any] = {}
        self._open()

    def _open(self) -> None:
        """Open the topics that the node reads."""
        self.remove_publishers()
        self._publishers = {
            name: self.observer.publisher(name)
            for name in ("/cistern/level", "/roof/level", "/weather/frost", "/pump/command",
                         "/pump/meter")
        }

    @property
    def drive(self) -> Simulator:
        """Return the drive; start it if necessary."""
        return self._drive or self.simulate()

    def simulate(
        self, *options: str, make: str = "abb_acs880", pace: tuple[str, ...] = PACE,
        port: int = 0,
    ) -> Simulator:
        """Start the simulated drive, which ends with the observer's nodes."""
        self._drive = Simulator(
            "drive_simulator", "--drive", make, *pace, "--port", str(port), "--workbench", "0",
            *options,
        )
        self.observer.started.append(self._drive.process)
        return self._drive

    def code(self, part: str) -> str:
        """Return the condition code of a part of the node; empty if the part is well."""
        return str(self.observer.values(f"/pump: {part}").get("code", ""))

    def start(
        self, address: str = "", *, popen: dict[str, Any] | None = None, **parameters: object,
    ) -> subprocess.Popen[Any]:
        """Start the node, by default with the simulated drive; its state file is kept."""
        settings = {
            "drive": guarding("abb_acs880", self.cwd),
            "address": address or self.drive.address,
            "site_file": parameters.get("site_file") or self.site(), "recovery_time": 0.3,
            "state_file": self.cwd / "state.json", **MIN_TIMES, **parameters,
        }
        self.states.clear()
        return self.observer.start("live.pump", popen=popen, **settings)

    def site(self, *lines: str) -> Path:
        """Write a site file with a short tau and further lines, and return it."""
        file = self.cwd / "site.yaml"
        tau = [] if any(line.startswith("tau") for line in lines) else [f"tau: {PERIOD_S}"]
        text = [f"extends: {CONFIG / 'site.yaml'}", "starts_per_hour: 3600", *tau, *lines]
        file.write_text("\n".join(text))
        return file

    def remove_publishers(self) -> None:
        """Remove all publishers."""
        for publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)

    @property
    def state(self) -> str:
        return self.states[-1] if self.states else ""

    def publish(self, name: str, value: float) -> None:
        self._publishers[name].publish(Float64(data=float(value)))

    def tick(self, command: float) -> float:
        """Publish the inputs of a tick, and return the newest flow at its end."""
        began, before, self._command = time.monotonic(), len(self.flows), command
        self.publish("/cistern/level", self._volumes[0] / 25.0)
        self.publish("/roof/level", self._volumes[1] / 68.8)
        self.publish("/weather/frost", 0.0)
        self.publish("/pump/command", command)
        self.observer.until(lambda: len(self.flows) > before, LATE, "a flow")
        remaining = began + PERIOD_S - time.monotonic()
        while remaining > 0:
            self.observer.executor.spin_once(timeout_sec=remaining)
            remaining = began + PERIOD_S - time.monotonic()
        flow = self.flows[-1]
        pumped = flow * PERIOD_S
        self._volumes = [self._volumes[0] - pumped, self._volumes[1] + pumped]
        return flow

    def pumped(self) -> float:
        """Return the volume that the flows so far have delivered (m3)."""
        times = self._flow_times
        return sum(
            flow * (after - before)
            for flow, (before, after) in zip(self.flows, pairwise(times), strict=False)
        )

    @property
    def drive_state(self) -> str:
        """The state of the node in its last report."""
        return str(self.observer.values("/pump").get("drive_state", ""))

    def tick_until(
        self, command: float, condition: Callable[[], Any], seconds: float, event: str
    ) -> float:
        """Publish ticks until a condition holds, and return how long that took (s)."""
        began = time.monotonic()

        def ticked() -> Any:
            self.tick(command)
            return condition()

        wait_for(ticked, seconds, f"{event} ({self.states[-3:]})")
        return time.monotonic() - began

    def until_reported(self, part: str, level: bytes, *words: str, command: float = 0.5) -> None:
        """Publish ticks until a part of the node reports this level with these words."""
        self.tick_until(command, lambda: self.shows(part, level, *words), LATE, f"{part}: {words}")

    def until_code(self, part: str, code: str, command: float = 0.5) -> None:
        """Publish ticks until a part of the node reports this code."""
        self.tick_until(command, lambda: self.code(part) == code, LATE, f"{part}: {code}")

    def until_at_rest(self, command: float = 0.5) -> None:
        """Publish ticks until the motor stands and flow is 0."""
        self.tick_until(
            command, lambda: self.drive.speed() == 0.0 and self.flows[-1] == 0.0, LATE, "a stop"
        )

    def run(self, command: float = 0.5) -> None:
        """Send a command until the pump runs."""
        self.join()
        self.tick_until(
            command, lambda: self.state.startswith("running") and self.drive.speed() > 0.5, 60,
            "running",
        )

    def join(self) -> None:
        """Wait until the node is in the graph."""
        self.observer.until(
            lambda: self.states and self._publishers["/pump/command"].get_subscription_count(),
            60, "the node",
        )

    def shows(self, part: str, level: bytes, *words: str) -> bool:
        """Return whether a part of the node reports this level with these words."""
        return self.observer.shows(f"/pump: {part}", level, *words)()

    def call(self, kind: Any, name: str, **fields: object) -> Any:
        """Call a service of the node, and go on publishing ticks meanwhile."""
        client = self.node.create_client(kind, f"/pump/{name}")
        self.tick_until(self._command, client.service_is_ready, LATE, name)
        future = client.call_async(kind.Request(**fields))
        self.tick_until(self._command, future.done, LATE, f"an answer of {name}")
        return future.result()
