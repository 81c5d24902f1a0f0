"""Watchers next to a real run, which is the same run, and does not wait for them."""

from __future__ import annotations

import filecmp
import os
import signal
from pathlib import Path

import pytest
from graphs import Process, bag_file, bring_up, wait_for
from page_server import read_state
from test_foxglove import port_of
from test_watch_command import child_of, end, watcher

pytest.importorskip("rclpy", reason="nodes need ROS 2")


def test_a_run_under_the_eyes_of_four_is_the_same_run(domain: int, tmp_path: Path) -> None:
    """A page that waits for it, one that is stopped, Foxglove, and its own, which is killed."""
    options = ("--controller", "onoff", "--hours", "0.15")
    page, port = watcher(domain, tmp_path)
    stopped, _ = watcher(domain, tmp_path)
    viewer = Process(domain, "watch", "--foxglove", "0", cwd=tmp_path)
    port_of(viewer.stdout)
    run = Process(
        domain, "bringup", *options, "--speed", "60", "--watch",
        "--output", "run", cwd=tmp_path,
    )
    wait_for(lambda: read_state(port)["mode"] == "simulated", 60, "the run on the page")
    stopped.process.send_signal(signal.SIGSTOP)
    killed = wait_for(lambda: child_of(run), 60, "a watcher")
    os.kill(killed, signal.SIGKILL)
    run.until_printed("the watcher has exited, and starts again in 2 s")
    wait_for(lambda: child_of(run) not in (0, killed), 60, "another watcher")
    assert run.wait(120) == 0, run.stderr()
    wait_for(lambda: read_state(port)["mode"] == "ended", 60, "the end of the run on the page")
    stopped.process.send_signal(signal.SIGCONT)
    end(page, signal.SIGTERM)
    end(stopped)
    end(viewer)
    bring_up(domain, tmp_path, *options, output="alone")
    bags = [bag_file(tmp_path / name) for name in ("run", "alone")]
    assert filecmp.cmp(*bags, shallow=False)
