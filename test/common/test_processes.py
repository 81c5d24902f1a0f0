"""Processes that end with their parent, and the messages that systemd receives."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import alive, wait_for
from places import CHECKOUT

from greenroof_ros.common.processes import (
    LockedError,
    acquire_name_lock,
    child_environment,
    scratch_directory,
)

TOO_LONG_S = 60

# A command of this package that prints its process id and then works for long.
_CHILD = """
import os, time
from greenroof_ros.common.command_line import command
@command
def main():
    print(os.getpid(), flush=True)
    time.sleep(600)
main()
"""
# Starts it, optionally late so that its parent can die before, and ends after a minute.
_PARENT = """
import subprocess, sys, time
from greenroof_ros.common.processes import child_environment
late = "import time; time.sleep(float(sys.argv[1]));" if len(sys.argv) > 1 else ""
subprocess.Popen(
    [sys.executable, "-c", "import sys;" + late + sys.stdin.read(), *sys.argv[1:]],
    env=child_environment(), stdin=subprocess.DEVNULL,
)
time.sleep(60)
"""


def start_parent(*arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", _PARENT, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
    )
    assert process.stdin is not None
    process.stdin.write(_CHILD)
    process.stdin.close()
    return process


def test_a_child_ends_with_a_parent_that_is_killed() -> None:
    parent = start_parent()
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    assert alive(child)
    parent.kill()
    parent.wait()
    wait_for(lambda: not alive(child), TOO_LONG_S, "the child's end")


def test_a_child_ends_whose_parent_died_while_it_started() -> None:
    """Before it could ask the kernel: it ends without any output."""
    parent = start_parent("3")
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    (child,) = wait_for(lambda: children.read_text().split(), TOO_LONG_S, "the child's start")
    parent.kill()
    parent.wait()
    assert alive(int(child))
    wait_for(lambda: not alive(int(child)), TOO_LONG_S, "the child's end")
    assert parent.stdout is not None and parent.stdout.read() == ""


def test_who_is_not_asked_lives_on() -> None:
    """And a child does not pass the request on to its own children."""
    code = _CHILD.replace("time.sleep(600)", "return int('GREENROOF_ROS_PARENT' in os.environ)")
    for environment, expected in (
        (dict(os.environ), 0), (child_environment(), 0),
        ({**os.environ, "GREENROOF_ROS_PARENT": "1"}, -signal.SIGTERM),
    ):
        done = subprocess.run(
            [sys.executable, "-c", code], env={**environment, "PYTHONPATH": str(CHECKOUT)},
            stdout=subprocess.PIPE, check=False,
        )
        assert done.returncode == expected


# --- locks --------------------------------------------------------------------------------------

_HOLDER = """
import sys, time
from greenroof_ros.common.processes import acquire_name_lock
lock = acquire_name_lock(sys.argv[1])
print("locked", flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize(("length", "user"), [(1, 65534), (300, None)])
def test_a_lock_is_its_process_alone_until_that_ends(
    length: int, user: int | None, tmp_path: Path
) -> None:
    """By kill -9, too; and stopped (SIGSTOP) it still holds the lock. Long names are no others.

    The first is held by a process of an unprivileged user, if root can start it.
    """
    name = f"test-{tmp_path}" + length * "x"
    code = _HOLDER
    if user is not None and os.getuid() == 0:
        code = code.replace("lock =", f"import os; os.setuid({user}); lock =")
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


# --- systemd ------------------------------------------------------------------------------------


def test_a_full_socket_stops_no_one(tmp_path: Path) -> None:
    """With a service manager that reads nothing; the time limit is the test."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        code = "from greenroof_ros.common.processes import notify\n" \
            "for _ in range(10_000): notify('WATCHDOG=1')"
        subprocess.run(
            [sys.executable, "-c", code], env={"NOTIFY_SOCKET": str(path)}, timeout=300, check=True,
            cwd=CHECKOUT,
        )


_SCRATCH = """
import sys, time
from greenroof_ros.common.processes import scratch_directory
with scratch_directory(sys.argv[1]) as directory:
    (directory / "configuration").mkdir()
    print(directory, flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_what_a_killed_process_leaves_is_removed_at_the_next_start(
    tmp_path: Path, number: signal.Signals
) -> None:
    """With what is in it; what a process still uses, even a stopped one, is not touched."""
    (tmp_path / "someone's").mkdir()
    (tmp_path / "greenroof_ros_scratch-link").symlink_to(tmp_path / "someone's")
    with subprocess.Popen(
        [sys.executable, "-c", _SCRATCH, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as other:
        try:
            assert other.stdout is not None
            left = Path(other.stdout.readline().strip())
            other.send_signal(number)
            if number is signal.SIGKILL:
                other.wait(TOO_LONG_S)
            assert left.is_dir()
            with scratch_directory(str(tmp_path)) as mine:
                assert mine.is_dir()
                assert left.is_dir() is (number is signal.SIGSTOP)
                with scratch_directory(str(tmp_path)) as another:
                    assert mine.is_dir() and another != mine
            assert not mine.exists()
            assert (tmp_path / "someone's").is_dir()
        finally:
            other.kill()
