"""A live node whose code fails reports the cause before it stops, and goes on reporting."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

from greenroof_ros.live.supervisor_socket import SOCKET, read_report


def test_the_cause_is_reported_before_the_stop_and_until_its_end(domain: int) -> None:
    """A pump that turns takes 38 s to stop, and the supervisor kills what is silent for 2 s."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("failing_node.py"))],
            env={**os.environ, SOCKET: str(theirs.fileno())}, pass_fds=[theirs.fileno()],
            stderr=subprocess.PIPE, text=True,
        )
        theirs.close()
        failed, times, states = list[str](), list[float](), list[str]()
        with ours.makefile("rb") as lines:
            for line in lines:
                report = read_report(line)
                if report is not None and "failure" in report:
                    failed.append(report["failure"])
                    times.append(time.monotonic())
                    states.append(report["state"])
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "ZeroDivisionError" in failed[0] and "failing_node.py, line 12" in failed[0]
    assert states[0] != "ended" and states[-1] == "ended"
    assert times[-1] - times[0] > 2.5  # from before the stop to after it
    assert max(b - a for a, b in itertools.pairwise(times)) < 2.0
    assert "Traceback" in errors and f"error: {failed[0]}" in errors
