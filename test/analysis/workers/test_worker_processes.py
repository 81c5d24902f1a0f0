"""Processes of this machine that work for a command, and their end."""

from __future__ import annotations

import threading
import time
from concurrent.futures import process
from pathlib import Path
from typing import Any

import pytest

from greenroof_ros.analysis.workers.processes import processes


def double(_: Path, number: int) -> int:
    return 2 * number


def test_no_thread_outlives_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of Python, a thread of the executor closed the pipe that woke it, too early.

    Here it is slow, as on a busy machine.
    """
    end = process._ExecutorManagerThread.join_executor_internals

    def end_late(self: Any) -> None:
        time.sleep(0.2)
        end(self)

    monkeypatch.setattr(process._ExecutorManagerThread, "join_executor_internals", end_late)
    before = threading.active_count()
    with processes(2, {}, [__name__]) as workers:
        futures = [workers.submit(double, number) for number in range(3)]
        assert [workers.result(future) for future in futures] == [0, 2, 4]
    assert threading.active_count() == before
