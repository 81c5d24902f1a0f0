"""A live node whose code fails: the cause is reported, and other nodes go on."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from graphs import environment, wait_for
from ros_rig import Observer

from greenroof_ros.live.upkeep import PIPE


class Run:
    """A process of :mod:`failing_node`, with the times of its heartbeats, and its reports."""

    def __init__(self, process: subprocess.Popen[str], reading: int, observer: Observer) -> None:
        """Begin without heartbeats and reports."""
        self.process, self._reading, self._observer = process, reading, observer
        self.beats: list[float] = []
        self.reports: list[tuple[float, str, str, dict[str, Any]]] = []
        observer.collect("/diagnostics", self._receive)

    def _receive(self, array: Any) -> None:
        self.reports += (
            (time.monotonic(), status.name, status.message,
             {pair.key: json.loads(pair.value) for pair in status.values})
            for status in array.status if ": " not in status.name
        )

    def read(self) -> bool:
        """Read what has arrived; return False at the end of the process."""
        self._observer.executor.spin_once(timeout_sec=0.05)
        with suppress(BlockingIOError):
            if not os.read(self._reading, 1 << 16):
                return False
            self.beats.append(time.monotonic())
        return True


@contextmanager
def running(kind: str, observer: Observer) -> Iterator[Run]:
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("failing_node.py")), kind],
        env={**environment(observer.domain), PIPE: str(writing)}, pass_fds=[writing],
        stderr=subprocess.PIPE, text=True,
    ) as process:
        os.close(writing)
        try:
            yield Run(process, reading, observer)
        finally:
            process.kill()
            os.close(reading)


def test_the_cause_is_reported_before_the_stop_and_until_its_end(observer: Observer) -> None:
    """A pump that turns takes 38 s to stop, and bringup kills what is silent for 2 s."""
    with running("alone", observer) as run:
        while run.read():
            pass
        _, errors = run.process.communicate(timeout=60)
    failed = [report for report in run.reports if "failure" in report[3]]
    assert run.process.returncode == 1
    first = failed[0][3]["failure"]
    assert "ZeroDivisionError" in first and "failing_node.py, line " in first
    assert failed[0][2] != "ended" and failed[-1][2] == "ended"
    assert run.beats[-1] - run.beats[0] > 2.5  # also during the stop
    assert max(b - a for a, b in itertools.pairwise(run.beats)) < 2.0
    assert "Traceback" in errors and f"error: {first}" in errors


def test_a_node_of_the_station_fails_alone(observer: Observer) -> None:
    """It is made again, and left out after more failures than it may have; the other goes on."""
    with running("station", observer) as run:
        def last_reports() -> set[str]:
            return {name for at, name, *_ in run.reports if at > time.monotonic() - 3.0}

        began = time.monotonic()
        wait_for(
            lambda: run.read() and time.monotonic() > began + 6 and last_reports() == {"/weather"},
            60, "the other node's reports alone",
        )
        run.process.send_signal(signal.SIGTERM)
        _, errors = run.process.communicate(timeout=60)
    assert run.process.returncode == 0
    assert errors.count("Traceback") == 3
    assert max(b - a for a, b in itertools.pairwise(run.beats)) < 2.0


def test_without_the_alarms_node_the_station_is_restarted(observer: Observer) -> None:
    """Nobody else tells of alarms, so the process ends when the node is to be left out."""
    with running("alarms", observer) as run:
        assert run.process.wait(60) == 1
        assert "ZeroDivisionError" in run.process.communicate()[1]
