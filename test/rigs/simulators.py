"""The simulators as programs, and a client for their workbenches."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import rig_simulators
from commands import Forked
from graphs import environment
from places import CHECKOUT, words_of
from rig_simulators import DEFAULT

from greenroof_ros.base.processes import child_environment
from greenroof_ros.live.devices.modbus_line import Address, DriveError, ModbusLine, parse_address

# How long to wait for a workbench (s): as long as a loaded machine needs.
PATIENCE_S = 30.0
T = TypeVar("T")

_PLACE = re.compile(r"(?:tcp|gateway)://127\.0\.0\.1:(\d+), device")


class Workbench:
    """A client of a simulator's workbench, always on TCP.

    Each method connects if necessary, and raises `DriveError` if there is no answer.
    """

    def __init__(self, address: Address, timeout_s: float = 1.0) -> None:
        self._line = ModbusLine(address, rig_simulators.BENCH, timeout_s)
        self.close = self._line.close

    def _request(self, request: Callable[[], T]) -> T:
        try:
            if not self._line.connected:
                self._line.connect()
            return request()
        except DriveError:
            self.close()
            raise

    def _write(self, register: int, value: int) -> None:
        self._request(lambda: self._line.write(register, value))

    def speed(self) -> float:
        """Return the true speed of the motor (share of rated)."""
        speed = self._request(lambda: self._line.read(rig_simulators.SPEED, 1))[0]
        return rig_simulators.SPEED_UNIT * speed

    def inject(self, fault: str, parameter: int = DEFAULT) -> None:
        """Inject a fault; there is one at a time, and ``none`` ends it."""
        self._write(rig_simulators.PARAMETER, parameter)
        self._write(rig_simulators.FAULT, rig_simulators.NUMBERS[fault])

    def take_over(self, local: bool) -> None:
        """Take over the drive at its panel, or hand it back to the bus."""
        self._write(rig_simulators.LOCAL, int(local))


class Simulator(Workbench):
    """A simulator that is ready, and its workbench; ``with`` ends it and checks how it ends.

    Attributes:
        address: of the device.
        ports: the port of each device on TCP, and last the workbench's.
    """

    def __init__(self, module: str, *options: str) -> None:
        self.process = Forked(
            [sys.executable, "-m", *words_of(module), *options],
            cwd=CHECKOUT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            stdin=subprocess.DEVNULL, env={**child_environment(), **environment(0)},
        )
        assert self.process.stdout is not None
        ready = self.process.stdout.readline()
        if not ready.startswith("ready: "):
            self.process.wait(120)
            raise AssertionError(f"{ready}{self.process.communicate()[1]}")
        self.address = ready.split()[2].rstrip(",")
        self.ports = [int(port) for port in _PLACE.findall(ready)]
        self.workbench = f"tcp://127.0.0.1:{self.ports[-1]}"
        self.output, self.errors = "", ""
        super().__init__(parse_address(self.workbench), PATIENCE_S)

    def end(self) -> int:
        """End it by Ctrl-C and return its exit code."""
        self.close()
        self.process.send_signal(signal.SIGINT)
        self.output, self.errors = self.process.communicate(timeout=120)
        return self.process.returncode

    def __enter__(self) -> Simulator:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        code = self.end()
        if kind is None:
            assert (code, self.errors) == (0, "")


def until(condition: Callable[[], object], seconds: float = 60.0) -> float:
    """Wait until a condition holds and return how long that took (s)."""
    began = time.monotonic()
    while not condition():
        assert time.monotonic() - began < seconds, "did not come to be so"
        time.sleep(0.005)
    return time.monotonic() - began
