"""The time limit of a live controller."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from greenroof_ros.live.time_limit import deciding_limit, silence_limit

LIMITED = """
import sys, time
from greenroof_ros.base.errors import HangError
from greenroof_ros.live.time_limit import time_limit
print("started", flush=True)
try:
    with time_limit(2.0):
        until = time.process_time() + float(sys.argv[1])
        while time.process_time() < until:
            pass
except HangError:
    print("ended")
"""


@pytest.mark.parametrize(("busy_s", "expected"), [("0.3", ""), ("1000", "ended\n")])
def test_a_pause_of_the_process_is_no_hang(busy_s: str, expected: str) -> None:
    """Stopped for longer than the limit, code that needs little time is not ended."""
    with subprocess.Popen(
        [sys.executable, "-c", LIMITED, busy_s], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "started\n"
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.5)
        process.send_signal(signal.SIGCONT)
        assert process.stdout.read() == expected


@pytest.mark.parametrize(("tau", "decides", "silent"), [(1.0, 3.0, 5.0), (8.0, 8.0, 10.0)])
def test_a_controller_that_may_still_decide_is_not_killed(
    tau: float, decides: float, silent: float
) -> None:
    assert (deciding_limit(tau), silence_limit(tau)) == (decides, silent)
