"""The end of a process with nodes: a lock-up of the middleware is ended."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
from graphs import environment

pytestmark = pytest.mark.graph


def test_a_lock_up_is_ended() -> None:
    """It spins in C, where no Python code can run."""
    program = "from greenroof_ros.ros.spin import end_soon; end_soon(); import re; " \
        "re.match('(a+)+$', 'a' * 64 + 'b')"
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(0), check=False, timeout=120
    )
    assert done.returncode == -signal.SIGALRM
