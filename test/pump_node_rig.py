"""A pump node as a process, a simulated drive as another, and the test as plant and controller."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from graphs import environment, wait_for
from lifecycle_msgs.srv import ChangeState, GetState
from places import CONFIG, guarding
from rosgraph_msgs.msg import Clock
from simulators import PATIENCE_S
from std_msgs.msg import Float64, String
from test_nodes import Observer, offered, qos

from greenroof_ros.drives.address import parse_address
from greenroof_ros.simulators.faults import DEFAULT
from greenroof_ros.simulators.workbench import Workbench

# Ten ticks of 1 s in a second, and a drive that ramps ten times as fast as in real time.
PERIOD_S, FACTOR = 0.1, 10
MAKES = {path.stem for path in (CONFIG / "drives").glob("*.yaml")}
OK, WARN, ERROR, STALE = b"\x00", b"\x01", b"\x02", b"\x03"
LEAST_TIMES = {"least_on": 1.0, "least_off": 1.0, "starts_per_hour": 3600.0}


class SimulatedDrive:
    """The program, and its workbench."""

    def __init__(self, domain: int, cwd: Path, *options: str, make: str = "abb_acs880") -> None:
        """Start it, and wait until it is ready."""
        self._command = [sys.executable, "-m", "greenroof_ros.drive_simulator", "--drive", make]
        self._command += ["--speed", str(FACTOR), "--boot", "0.1", "--timeout", "1.5", *options]
        self._domain, self._cwd = domain, cwd
        self.start("--port", "0", "--workbench", "0")

    def start(self, *options: str) -> None:
        self.process = subprocess.Popen(
            [*self._command, *options], cwd=self._cwd, env=environment(self._domain),
            stdout=subprocess.PIPE, text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        found = re.match(r"ready: drive (\S+), .*; workbench (\S+),", line)
        assert found, line
        self.address, self._workbench = found[1], found[2]

    def ask(self, question: Callable[[Workbench], Any]) -> Any:
        """Do something at the workbench."""
        workbench = Workbench(parse_address(self._workbench), timeout_s=PATIENCE_S)
        try:
            return question(workbench)
        finally:
            workbench.close()

    def speed(self) -> float:
        """Return the true speed of the motor, share of rated."""
        return float(self.ask(lambda bench: bench.speed()))

    def inject(self, fault: str, parameter: int = DEFAULT) -> None:
        self.ask(lambda bench: bench.inject(fault, parameter))

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(120)


class PumpRig:
    """The node's peers: clock, levels, frost and commands, and what the node says to them."""

    def __init__(self, domain: int, cwd: Path, observer: Observer) -> None:
        self.cwd, self.observer = cwd, observer
        self.domain = domain
        self.node = observer.node
        self.flows: list[float] = []
        self.states: list[str] = []
        self.diagnoses: dict[str, tuple[bytes, str, str]] = {}
        self.values: dict[str, dict[str, str]] = {}
        self.every_tick: Callable[[], None] = lambda: None
        self._ticks = 0
        self._volumes = [75.0, 0.3]
        self._processes: list[subprocess.Popen[bytes]] = []
        self._publishers: dict[str, Any] = {}
        self._open()
        self.node.create_subscription(
            Float64, "/pump/flow", lambda message: self.flows.append(message.data),
            qos("/pump/flow"),
        )
        self.node.create_subscription(
            String, "/pump/state", lambda message: self.states.append(message.data),
            qos("/pump/state"),
        )
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, qos("/diagnostics")
        )

    def _open(self) -> None:
        """Begin without a past: a node that is started again takes part from the next tick on."""
        self.leave()
        self._publishers = {
            name: self.node.create_publisher(kind, name, offered(name))
            for name, kind in (
                ("/clock", Clock), ("/cistern/level", Float64), ("/roof/level", Float64),
                ("/weather/frost", Float64), ("/pump/command", Float64), ("/pump/meter", Float64),
            )
        }

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnoses[status.name] = (status.level, status.message, status.hardware_id)
            self.values[status.name] = {one.key: one.value for one in status.values}

    def code(self, part: str) -> str:
        """Return the condition code of a part; empty where it is well."""
        return self.values.get(f"/pump: {part}", {}).get("code", "")

    def start(
        self, address: str, *, drive: str = "abb_acs880", popen: dict[str, Any] | None = None,
        **parameters: object,
    ) -> subprocess.Popen[bytes]:
        """Start the node; its state file is the same each time."""
        given = {
            "drive": guarding(drive, self.cwd) if drive in MAKES else drive,
            "address": address, "autostart": "true", "exchange_period": 0.05,
            "state_file": self.cwd / "state.json", **LEAST_TIMES, **parameters,
        }
        self.states.clear()
        if self._processes:
            self._open()
        process = subprocess.Popen(
            [
                sys.executable, "-m", "greenroof_ros.nodes.pump", "--ros-args",
                *(word for name, value in given.items() if value is not None
                for word in ("-p", f"{name}:={value}")),
            ],
            cwd=self.cwd, **{"env": environment(self.domain), **(popen or {})},
        )
        self._processes.append(process)
        return process

    def leave(self) -> None:
        """Have no publishers any more."""
        for publisher in self._publishers.values():
            self.node.destroy_publisher(publisher)

    def end(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
                process.wait(120)

    @property
    def state(self) -> str:
        return self.states[-1] if self.states else ""

    def publish(self, name: str, value: float) -> None:
        self._publishers[name].publish(Float64(data=float(value)))

    def send_nonsense(self) -> None:
        """Publish a command that is cut off."""
        self._publishers["/pump/command"].publish(b"\x00\x01\x00\x00\x00")

    def tick(self, command: float) -> float:
        """Publish a tick, and return its flow; there is exactly one."""
        began, before = time.monotonic(), len(self.flows)
        self.every_tick()
        clock = Clock()
        clock.clock.sec = 1_751_371_200 + self._ticks
        self._publishers["/clock"].publish(clock)
        self.publish("/cistern/level", self._volumes[0] / 25.0)
        self.publish("/roof/level", self._volumes[1] / 68.8)
        self.publish("/weather/frost", 0.0)
        self.publish("/pump/command", command)
        self._ticks += 1
        self.observer.until(lambda: len(self.flows) > before, 10, "a flow")
        rest = began + PERIOD_S - time.monotonic()
        while rest > 0:
            self.observer.executor.spin_once(timeout_sec=rest)
            rest = began + PERIOD_S - time.monotonic()
        assert len(self.flows) == before + 1
        flow = self.flows[-1]
        self._volumes = [self._volumes[0] - flow, self._volumes[1] + flow]
        return flow

    def tick_until(
        self, command: float, condition: Callable[[], Any], seconds: float, what: str
    ) -> float:
        """Publish ticks until a condition holds, and return how long that took (s)."""
        began = time.monotonic()

        def ticked() -> Any:
            self.tick(command)
            return condition()

        wait_for(ticked, seconds, f"{what} ({self.states[-3:]}, {self.diagnoses})")
        return time.monotonic() - began

    def run(self, drive: SimulatedDrive, command: float = 0.5) -> None:
        """Command until the pump runs."""
        self.join()
        self.tick_until(
            command, lambda: self.state.startswith("running") and drive.speed() > 0.5, 60, "running"
        )

    def join(self) -> None:
        """Wait until the node is in the graph."""
        self.observer.until(
            lambda: self.states and self._publishers["/pump/command"].get_subscription_count(),
            60, "the node",
        )

    def says(self, part: str, level: bytes, *words: str) -> bool:
        """Whether a part of the node is at a level, with some words."""
        found = self.diagnoses.get(f"/pump: {part}")
        return found is not None and found[0] == level and all(w in found[1] for w in words)

    def call(self, kind: Any, name: str, **fields: object) -> Any:
        """Call a service of the node."""
        client = self.node.create_client(kind, f"/pump/{name}")
        self.observer.until(client.service_is_ready, 20, name)
        future = client.call_async(kind.Request(**fields))
        self.observer.until(future.done, 15, f"an answer of {name}")
        return future.result()

    def change(self, label: str) -> bool:
        """Ask for a transition."""
        request = ChangeState.Request()
        request.transition.label = label
        return bool(self.call(ChangeState, "change_state", transition=request.transition).success)

    def lifecycle_state(self) -> str:
        return str(self.call(GetState, "get_state").current_state.label)


def stands_within(drive: SimulatedDrive, seconds: float) -> float:
    """Wait until the motor stands, and return how long that took (s)."""
    began = time.monotonic()
    wait_for(lambda: drive.speed() == 0.0, seconds, "the motor's standstill")
    return time.monotonic() - began
