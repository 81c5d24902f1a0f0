"""A live node whose code fails: the cause is reported, and other nodes go on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest
from graphs import environment, wait_for
from ros_rig import Observer

from greenroof_ros.live.upkeep import PIPE


class Run:
    """A process of :mod:`failing_node`.

    Attributes:
        beats: the times of its heartbeats (s).
        reports: of each report the time (s), the sender, the state and all texts.
    """

    def __init__(self, kind: str, observer: Observer) -> None:
        self.beats: list[float] = []
        self.reports: list[tuple[float, str, str, str]] = []
        self._reading, writing = os.pipe()
        os.set_blocking(self._reading, False)
        self._observer = observer
        observer.collect("/diagnostics", lambda array: self.reports.extend(
            (time.monotonic(), each.name, each.message, " ".join(one.value for one in each.values))
            for each in array.status if ": " not in each.name
        ))
        self.process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("failing_node.py")), kind],
            env={**environment(observer.domain), PIPE: str(writing)}, pass_fds=[writing],
            stderr=subprocess.PIPE, text=True,
        )
        observer.started.append(self.process)
        os.close(writing)

    def read(self) -> bool:
        """Read what has arrived; return False at the end of the process."""
        self._observer.executor.spin_once(timeout_sec=0.05)
        with suppress(BlockingIOError):
            if not os.read(self._reading, 1 << 16):
                return False
            self.beats.append(time.monotonic())
        return True

    def end(self) -> tuple[int, str]:
        """Read until it has ended; return its exit code, and what it has printed as errors."""
        wait_for(lambda: not self.read(), 60, "its end")
        os.close(self._reading)
        _, errors = self.process.communicate(timeout=60)
        # Bringup kills what is silent for 2 s.
        assert max(b - a for a, b in pairwise(self.beats)) < 2.0
        return self.process.returncode, errors


def test_the_cause_is_reported_before_the_stop_and_until_its_end(observer: Observer) -> None:
    """A pump that turns takes 38 s to stop."""
    run = Run("alone", observer)
    code, errors = run.end()
    failed = [report for report in run.reports if "ZeroDivisionError" in report[3]]
    assert code == 1 and "Traceback" in errors and "error: ZeroDivisionError: " in errors
    assert "failing_node.py, line " in failed[0][3]
    assert failed[0][2] != "ended" and failed[-1][2] == "ended"
    assert run.beats[-1] - run.beats[0] > 2.5  # also during the stop


@pytest.mark.parametrize("kind", ["station", "alarms"])
def test_a_node_of_the_station_fails_alone(observer: Observer, kind: str) -> None:
    """It is made again, and left out after more failures than it may have; the other goes on.

    Nobody else tells of alarms, so without the alarms node the process ends.
    """
    run = Run(kind, observer)

    def is_left_out() -> bool:
        assert run.read()
        now = time.monotonic()
        last = {name for at, name, *_ in run.reports if at > now - 3.0}
        return now > began + 6 and last == {"/weather"}

    if kind == "station":
        began = time.monotonic()
        wait_for(is_left_out, 60, "the other node's reports alone")
        run.process.send_signal(signal.SIGTERM)
    code, errors = run.end()
    assert code == (kind == "alarms")
    assert errors.count("Traceback") == 3
