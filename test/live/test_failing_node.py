"""A live node whose code fails: the cause is reported, and other nodes go on."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from graphs import wait_for

from greenroof_ros.live.supervisor_socket import SOCKET, read_report


class Run:
    """A process of :mod:`failing_node`, and its reports."""

    def __init__(self, process: subprocess.Popen[str], reading: socket.socket) -> None:
        """Begin without reports."""
        self.process, self._reading, self._rest = process, reading, b""
        self.reports: list[tuple[float, dict[str, Any]]] = []

    def read(self) -> bool:
        """Read what has arrived; return False at the end of the process."""
        data = self._reading.recv(1 << 16)
        *lines, self._rest = (self._rest + data).split(b"\n")
        now = time.monotonic()
        self.reports += ((now, report) for line in lines if (report := read_report(line)))
        return bool(data)


@contextmanager
def running(kind: str) -> Iterator[Run]:
    ours, theirs = socket.socketpair()
    with ours, subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("failing_node.py")), kind],
        env={**os.environ, SOCKET: str(theirs.fileno())}, pass_fds=[theirs.fileno()],
        stderr=subprocess.PIPE, text=True,
    ) as process:
        theirs.close()
        yield Run(process, ours)
        process.kill()


def test_the_cause_is_reported_before_the_stop_and_until_its_end(domain: int) -> None:
    """A pump that turns takes 38 s to stop, and the supervisor kills what is silent for 2 s."""
    with running("alone") as run:
        while run.read():
            pass
        _, errors = run.process.communicate(timeout=60)
    failed = [(at, report) for at, report in run.reports if "failure" in report]
    assert run.process.returncode == 1
    first = failed[0][1]["failure"]
    assert "ZeroDivisionError" in first and "failing_node.py, line " in first
    assert failed[0][1]["state"] != "ended" and failed[-1][1]["state"] == "ended"
    times = [at for at, _ in failed]
    assert times[-1] - times[0] > 2.5  # from before the stop to after it
    assert max(b - a for a, b in itertools.pairwise(times)) < 2.0
    assert "Traceback" in errors and f"error: {first}" in errors


def test_a_node_of_the_station_fails_alone(domain: int) -> None:
    """It is made again, and left out after more failures than it may have; the other goes on."""
    with running("station") as run:

        def failures() -> list[float]:
            return [at for at, report in run.reports if report["state"] == "ended"]

        wait_for(lambda: run.read() and len(failures()) == 3, 60, "the last failure")
        until = time.monotonic() + 3
        wait_for(lambda: run.read() and time.monotonic() > until, 60, "the other node's reports")
        run.process.send_signal(signal.SIGTERM)
        assert run.process.wait(60) == 0
    assert len(failures()) == 3
    assert {report["node"] for at, report in run.reports if at > failures()[-1]} == {"weather"}
    others = [at for at, report in run.reports if report["node"] == "weather"]
    assert max(b - a for a, b in itertools.pairwise(others)) < 2.0
