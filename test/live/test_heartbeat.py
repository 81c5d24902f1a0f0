"""Nobody who does not read stops a process: neither bringup its nodes, nor systemd bringup."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from places import CHECKOUT

from greenroof_ros.live.upkeep import PIPE, send_beat


def test_a_heartbeat_that_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    monkeypatch.setenv(PIPE, str(writing))
    for reached in (False, True):
        send_beat(reached)
        assert os.read(reading, 10) == bytes([reached])
    for _ in range(100_000):
        send_beat(True)
    os.close(reading)
    send_beat(True)
    os.close(writing)


def test_a_full_socket_of_systemd(tmp_path: Path) -> None:
    """The time limit is the test."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        code = "from greenroof_ros.live.site_run import notify\n" \
            "for _ in range(10_000): notify('WATCHDOG=1')"
        subprocess.run(
            [sys.executable, "-c", code], env={"NOTIFY_SOCKET": str(path)}, timeout=300, check=True,
            cwd=CHECKOUT,
        )
