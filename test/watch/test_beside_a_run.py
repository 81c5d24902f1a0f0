"""Watchers next to real runs: alarms come and go, a stop holds, and the bag stays the same."""

from __future__ import annotations

import filecmp
import os
import signal
import socket
import time
from pathlib import Path

import pytest
from browsers import started_browser
from graphs import Process, bag_file, bring_up, wait_for
from test_foxglove import deaf_client, port_of
from test_watch_command import child_of, end, watcher

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")


def test_a_run_under_the_eyes_of_four_is_the_same_run(domain: int, tmp_path: Path) -> None:
    """A page that waits for it, one that never reads, and a slow one; the watcher is stopped.

    And Foxglove, with a client that subscribes to everything and never reads. The run's own page is
    killed.
    """
    options = ("--controller", "onoff", "--hours", "0.15")
    process, port = watcher(domain, tmp_path)
    viewer = Process(domain, "watch", "--foxglove", "0", cwd=tmp_path)
    request = b"GET /uPlot.js HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with (
        started_browser() as browser, deaf_client(port_of(viewer.stdout)),
        socket.create_connection(("127.0.0.1", port)) as deaf,
        socket.create_connection(("127.0.0.1", port)) as slow,
    ):
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        deaf.sendall(request)
        slow.sendall(request)
        page = browser.new_page()
        page.set_default_timeout(60_000)
        page.goto(f"http://127.0.0.1:{port}/")
        run = Process(
            domain, "bringup", *options, "--speed", "60", "--watch", "--foxglove", "0",
            "--output", "run", cwd=tmp_path,
        )
        page.wait_for_selector("#heading:has-text('Simulated run')")
        assert slow.recv(512)
        killed = wait_for(lambda: child_of(run), 60, "a watcher")
        os.kill(killed, signal.SIGKILL)
        run.until_printed("the watcher has exited, and starts again in 2 s")
        wait_for(lambda: child_of(run) not in (0, killed), 60, "another watcher")
        process.process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.process.send_signal(signal.SIGCONT)
        assert run.wait(120) == 0, run.stderr()
        page.wait_for_selector("#heading:has-text('Ended run')")
    end(process, signal.SIGTERM)
    end(viewer)
    bring_up(domain, tmp_path, *options, output="alone")
    bags = [bag_file(tmp_path / name) for name in ("run", "alone")]
    assert filecmp.cmp(*bags, shallow=False)
