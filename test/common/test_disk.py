"""The thread that writes: in order, with limited room, and without a mistake ending it."""

from __future__ import annotations

import threading
from functools import partial

import pytest

from greenroof_ros.common.disk import DiskThread

TOO_LONG_S = 60


class Newest:
    """Writes what is newest, into a list."""

    def __init__(self) -> None:
        self.value = 0
        self.written: list[int] = []

    def write(self) -> None:
        self.written.append(self.value)


def test_what_waits_is_done_in_order_and_what_finds_no_room_is_counted() -> None:
    disk, hangs, done = DiskThread(room=2000), threading.Event(), list[int]()
    assert disk.do(hangs.wait)
    accepted = [disk.do(partial(done.append, number), 300) for number in range(5)]
    assert accepted == [True, True, True, False, False]
    assert disk.refused == 2
    assert not disk.wait(0.1) and done == []
    hangs.set()
    assert disk.wait(TOO_LONG_S) and done == [0, 1, 2]
    assert disk.do(partial(done.append, 5), 1500)  # there is room again
    assert disk.wait(TOO_LONG_S) and done == [0, 1, 2, 5]


def test_the_newest_waits_once() -> None:
    disk, hangs, newest = DiskThread(), threading.Event(), Newest()
    assert disk.do(hangs.wait)
    for value in range(100):
        newest.value = value
        assert disk.do(newest.write)
    hangs.set()
    assert disk.wait(TOO_LONG_S) and newest.written == [99]


def test_a_mistake_in_one_job_ends_no_other(capfd: pytest.CaptureFixture[str]) -> None:
    disk, newest = DiskThread(), Newest()
    disk.do(partial(int, "x"))
    disk.do(newest.write)
    assert disk.wait(TOO_LONG_S) and newest.written == [0]
    assert "ValueError" in capfd.readouterr().err
