"""Processes that end with the one that started them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

from graphs import alive, wait_for
from places import CHECKOUT

from greenroof_ros.common.processes import asked_to_end_with_this

TOO_LONG_S = 60

# A command of this package that says its number and then works for long.
_CHILD = """
import os, time
from greenroof_ros.common.command_line import command
@command
def main():
    print(os.getpid(), flush=True)
    time.sleep(600)
main()
"""
# Starts it after a while, in which its own parent may die, and ends by itself in a minute.
_PARENT = """
import subprocess, sys, time
from greenroof_ros.common.processes import asked_to_end_with_this
late = "import time; time.sleep(float(sys.argv[1]));" if len(sys.argv) > 1 else ""
subprocess.Popen(
    [sys.executable, "-c", "import sys;" + late + sys.stdin.read(), *sys.argv[1:]],
    env=asked_to_end_with_this(), stdin=subprocess.DEVNULL,
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
    """Before it could ask the kernel: its output ends, and it never said a word."""
    parent = start_parent("3")
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    (child,) = wait_for(lambda: children.read_text().split(), TOO_LONG_S, "the child's start")
    parent.kill()
    parent.wait()
    assert alive(int(child))
    wait_for(lambda: not alive(int(child)), TOO_LONG_S, "the child's end")
    assert parent.stdout is not None and parent.stdout.read() == ""


def test_who_is_not_asked_lives_on() -> None:
    """And what a child starts in turn is its own."""
    code = _CHILD.replace("time.sleep(600)", "return int('GREENROOF_ROS_PARENT' in os.environ)")
    for environment, expected in (
        (dict(os.environ), 0), (asked_to_end_with_this(), 0),
        ({**os.environ, "GREENROOF_ROS_PARENT": "1"}, -signal.SIGTERM),
    ):
        done = subprocess.run(
            [sys.executable, "-c", code], env={**environment, "PYTHONPATH": str(CHECKOUT)},
            stdout=subprocess.PIPE, check=False,
        )
        assert done.returncode == expected
