"""A live node whose code fails: the cause is reported, and other nodes go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from graphs import environment
from ros_rig import Observer

from greenroof_ros.live.upkeep import PIPE


@pytest.mark.parametrize(("kind", "code", "failures"), [
    ("alone", 1, 1), ("station", 0, 3), ("alarms", 1, 3),
])
def test_a_node_that_fails(observer: Observer, kind: str, code: int, failures: int) -> None:
    """The cause is reported before the stop, which for a pump that turns takes 38 s, until its end.

    In the station it fails alone: it is made again, and left out after more failures than it may
    have; the other goes on. Nobody else tells of alarms, so without the alarms node the process
    ends.
    """
    beats: list[float] = []
    reports: list[tuple[float, Any]] = []
    observer.collect("/diagnostics", lambda array: reports.extend(
        (time.monotonic(), each) for each in array.status if ": " not in each.name
    ))
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    process = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("failing_node.py")), kind],
        env={**environment(observer.domain), PIPE: str(writing)}, pass_fds=[writing],
        stderr=subprocess.PIPE, text=True,
    )
    observer.started.append(process)
    os.close(writing)
    began = time.monotonic()

    def ended() -> bool:
        try:
            data = os.read(reading, 1 << 16)
        except BlockingIOError:
            return False
        beats.append(time.monotonic())
        return not data

    def left_out() -> bool:
        assert not ended()
        now = time.monotonic()
        return now > began + 6 and {
            each.name for at, each in reports if at > now - 3
        } == {"/weather"}

    if kind == "station":
        observer.until(left_out, 60, "the other node's reports alone")
        process.send_signal(signal.SIGTERM)
    observer.until(ended, 60, "its end")
    os.close(reading)
    _, errors = process.communicate(timeout=60)
    # Bringup kills what is silent for 2 s.
    assert max(b - a for a, b in pairwise(beats)) < 2.0
    assert (process.returncode, errors.count("Traceback")) == (code, failures), errors
    assert "error: ZeroDivisionError: " in errors or kind == "station"
    if kind == "alone":
        texts = [(each.message, " ".join(one.value for one in each.values)) for _, each in reports]
        failed = [message for message, text in texts if "failing_node.py, line " in text]
        assert failed[0] != "ended" and failed[-1] == "ended"
        assert beats[-1] - beats[0] > 2.5  # also during the stop
