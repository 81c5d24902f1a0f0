"""Processes that end with their parent, locks, and temporary files."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from places import CHECKOUT

from greenroof_ros.base.processes import (
    LockedError,
    acquire_name_lock,
    scratch_directory,
)

TOO_LONG_S = 60

# --- locks --------------------------------------------------------------------------------------

_HOLDER = """
import sys, time
from greenroof_ros.base.processes import acquire_name_lock
lock = acquire_name_lock(sys.argv[1])
print("locked", flush=True)
time.sleep(600)
"""


def test_a_lock_is_its_process_alone_until_that_ends(tmp_path: Path) -> None:
    """By kill -9, too; and stopped (SIGSTOP) it still holds the lock. Long names are no others.

    It is held by a process of an unprivileged user, if root can start it.
    """
    name = f"test-{tmp_path}" + 300 * "x"
    code = _HOLDER
    if os.getuid() == 0:
        code = code.replace("lock =", "import os; os.setuid(65534); lock =")
    holder = subprocess.Popen(
        [sys.executable, "-c", code, name], stdout=subprocess.PIPE, cwd=CHECKOUT
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline() == b"locked\n"
        holder.send_signal(signal.SIGSTOP)
        for _ in range(2):
            with pytest.raises(LockedError) as caught:
                acquire_name_lock(name)
            assert caught.value.holder == holder.pid
        acquire_name_lock(name + "y").close()
    finally:
        holder.kill()
        holder.communicate()
    acquire_name_lock(name).close()


_SCRATCH = """
import sys, time
from greenroof_ros.base.processes import scratch_directory
with scratch_directory(sys.argv[1]) as directory:
    (directory / "configuration").mkdir()
    print(directory, flush=True)
    time.sleep(600)
"""


def test_what_a_killed_process_leaves_is_removed_at_the_next_start(tmp_path: Path) -> None:
    """With what is in it; what a process still uses, even a stopped one, is not touched."""
    (tmp_path / "someone's").mkdir()
    (tmp_path / "greenroof_ros_temporary-link").symlink_to(tmp_path / "someone's")
    with subprocess.Popen(
        [sys.executable, "-c", _SCRATCH, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        left = Path(other.stdout.readline().strip())
        other.send_signal(signal.SIGSTOP)
        os.utime(left / "lock", (0, 0))
        with scratch_directory(str(tmp_path)) as mine:
            assert mine.is_dir() and left.is_dir()
            other.kill()
            other.wait(TOO_LONG_S)
            with scratch_directory(str(tmp_path)) as another:
                assert mine.is_dir() and another != mine and not left.exists()
        assert not mine.exists() and (tmp_path / "someone's").is_dir()
