"""A live node whose code fails: the cause is reported, and other nodes go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from graphs import environment
from ros_rig import LATE, Observer

from greenroof_ros.live.upkeep import PIPE


@pytest.mark.parametrize(("kind", "code", "failures"), [
    ("alone", 1, 1), ("station", 0, 3), ("alarms", 1, 3),
])
def test_a_node_that_fails_is_reported_and_stops_its_device_with_heartbeats(
    observer: Observer, kind: str, code: int, failures: int
) -> None:
    """The cause is reported before the stop, which for a pump that turns takes 38 s.

    In the station it fails alone: it is made again, and left out after more failures than it may
    have; the other goes on. Nobody else tells of alarms, so without the alarms node the process
    ends.
    """
    reports: list[tuple[float, Any]] = []
    observer.collect("/diagnostics", lambda array: reports.extend(
        (time.monotonic(), each) for each in array.status if ": " not in each.name
    ))
    reading, writing = os.pipe()
    errors = observer.cwd / "errors"
    with errors.open("w") as stream:
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("failing_node.py")), kind],
            env={**environment(observer.domain), PIPE: str(writing)}, pass_fds=[writing],
            stderr=stream, cwd=observer.cwd,
        )
    observer.started.append(process)
    os.close(writing)

    def failed() -> bool:
        return any(
            "failing_node.py, line " in " ".join(value.value for value in each.values)
            and each.message != "ended" for _, each in reports
        )

    def left_out() -> bool:
        late = {each.name for at, each in reports if at > time.monotonic() - 3}
        return (
            errors.read_text().count("Traceback") == failures and failed() and late == {"/weather"}
        )

    if kind != "alarms":
        observer.until(lambda: any(each.name == "/recorder" for _, each in reports), LATE, "news")
        (observer.cwd / "observed").touch()
    if kind == "alone":
        observer.until(failed, LATE, "the cause, before the stop ends")
        for _ in range(3):
            assert os.read(reading, 1 << 16), "a heartbeat during the stop"
            time.sleep(1.0)
        (observer.cwd / "stopped").touch()
    if kind == "station":
        observer.until(left_out, LATE, "the other node's reports alone")
        process.send_signal(signal.SIGTERM)
    assert process.wait(300) == code
    os.close(reading)
    assert errors.read_text().count("Traceback") == failures
    assert "error: ZeroDivisionError: " in errors.read_text() or kind == "station"
