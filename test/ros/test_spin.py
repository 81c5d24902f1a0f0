"""The end of a process with nodes: a lock-up of the middleware is ended, a slow end is not."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from graphs import environment

pytestmark = pytest.mark.graph


@pytest.mark.parametrize(("end", "code"), [
    # It spins in C, where no Python code can run.
    ("import re; re.match('(a+)+$', 'a' * 64 + 'b')", -signal.SIGPROF),
    ("import time; time.sleep(8)", 0),
])
def test_a_lock_up_is_ended(end: str, code: int) -> None:
    program = f"from greenroof_ros.ros.spin import end_soon; end_soon(); {end}"
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(0), check=False, timeout=120
    )
    assert done.returncode == code
