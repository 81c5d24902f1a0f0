"""Who writes to a disk or to standard error that hangs waits for neither, in limited memory."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from functools import partial

import pytest
from disks import full_pipe
from places import CHECKOUT

from greenroof_ros.base.disk import DiskThread
from greenroof_ros.base.standard_error import Lines

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


def test_what_finds_no_room_is_dropped_and_counted() -> None:
    """As soon as someone reads, what waited comes in order, and the next line tells the number."""
    with full_pipe() as (reading, writing):
        lines = Lines(writing)
        for number in range(6000):
            lines.print_line(f"line {number}\n  of °C")
        assert not lines.wait(0.0)
        printed = _empty(reading)
        while not lines.wait(0.01):
            printed += _empty(reading)
        lines.print_line("last")
        assert lines.wait(TOO_LONG_S)
        *waited, dropped, last = (printed + _empty(reading)).lstrip(b"\0").decode().splitlines()
    count = len(waited) // 2
    assert waited == [text for number in range(count) for text in (f"line {number}", "  of °C")]
    assert dropped == f"{6000 - count} lines were dropped: standard error was blocked"
    assert count > 4000 and last == "last"


@pytest.mark.parametrize("full", [False, True])
def test_the_end_of_a_process(full: bool) -> None:
    """It writes what waits, and gives up after two seconds."""
    program = (
        "from greenroof_ros.base.standard_error import print_line\n"
        "for number in range(3): print_line(f'line {number}')"
    )
    with full_pipe() as (reading, writing):
        if not full:
            _empty(reading)
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, cwd=CHECKOUT, stderr=writing, timeout=TOO_LONG_S)
        assert done.returncode == 0
        printed = _empty(reading).lstrip(b"\0")
    assert printed == (b"" if full else b"line 0\nline 1\nline 2\n")


def _empty(reading: int) -> bytes:
    """Return all that is in a pipe, without waiting for more."""
    os.set_blocking(reading, False)
    printed = b""
    try:
        while True:
            printed += os.read(reading, 1 << 20)
    except BlockingIOError:
        return printed
    finally:
        os.set_blocking(reading, True)


def test_a_line_that_others_can_cause_is_printed_once_a_minute(
    monkeypatch: pytest.MonkeyPatch
) -> None:
    printed: list[str] = []
    lines, now = Lines(2), 100.0
    monkeypatch.setattr(lines, "print_line", printed.append)
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for now in (100.0, 130.0, 159.0, 160.0):
        lines.print_seldom("stop", f"refused at {now:g}")
    lines.print_seldom("another kind", "printed")
    assert printed == [
        "refused at 100", "refused at 160 (and 2 similar messages before it)", "printed",
    ]
