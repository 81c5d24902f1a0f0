"""A thread that writes to disk in order, in limited memory, even if the disk hangs or is full."""

from __future__ import annotations

import threading
import time
from functools import partial

import pytest

from greenroof_ros.base.disk import DiskThread

TOO_LONG_S = 60


def test_what_waits_is_done_in_order_and_what_finds_no_room_is_counted() -> None:
    disk, hangs, done = DiskThread(), threading.Event(), list[int]()
    assert disk.do(hangs.wait)
    accepted = [disk.do(partial(done.append, number), 9_000_000) for number in range(5)]
    assert accepted == [True, True, True, False, False]
    assert disk.refused == 2
    assert not disk.wait(0.1) and done == []
    hangs.set()
    assert disk.wait(TOO_LONG_S) and done == [0, 1, 2]
    assert disk.do(partial(done.append, 5), 31_000_000)  # there is room again
    assert disk.wait(TOO_LONG_S) and done == [0, 1, 2, 5]


def test_the_newest_waits_once_and_a_mistake_in_one_job_ends_no_other(
    capfd: pytest.CaptureFixture[str],
) -> None:
    disk, hangs, values, written = DiskThread(), threading.Event(), list[int](), list[int]()

    def write() -> None:
        written.append(values[-1])

    assert disk.do(hangs.wait)
    disk.do(partial(int, "x"))
    began = time.process_time()
    for value in range(8000):
        values.append(value)
        assert disk.do(write) and disk.do(partial(int, value))
    assert time.process_time() - began < 2  # with a search it would be ten
    hangs.set()
    assert disk.wait(TOO_LONG_S) and written == [7999]
    assert "ValueError" in capfd.readouterr().err
