"""The messages that systemd receives."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

from places import CHECKOUT


def test_a_full_socket_stops_no_one(tmp_path: Path) -> None:
    """With a service manager that reads nothing; the time limit is the test."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        code = "from greenroof_ros.live.service_manager import notify\n" \
            "for _ in range(10_000): notify('WATCHDOG=1')"
        subprocess.run(
            [sys.executable, "-c", code], env={"NOTIFY_SOCKET": str(path)}, timeout=300, check=True,
            cwd=CHECKOUT,
        )
