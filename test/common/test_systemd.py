"""What systemd would receive, by a socket as it has one."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from greenroof_ros.common.processes import notify


@pytest.mark.parametrize("abstract", [False, True])
def test_a_datagram_arrives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool
) -> None:
    """By a socket in the file system, and by one with a name of its own (sd_notify(3))."""
    name = f"greenroof-test-{tmp_path.name}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(f"\0{name}" if abstract else name)
        receiver.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}" if abstract else name)
        notify("READY=1", "STATUS=all nodes are here")
        assert receiver.recv(4096) == b"READY=1\nSTATUS=all nodes are here"


def test_nobody_listens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without systemd, or while it is started again, the site runs on."""
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    notify("READY=1")


def test_a_full_socket_stops_nobody(tmp_path: Path) -> None:
    """A service manager that reads nothing; the limit on the time is the test."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(path))
        code = "from greenroof_ros.common.processes import notify\n" \
            "for _ in range(10_000): notify('WATCHDOG=1')"
        subprocess.run(
            [sys.executable, "-c", code], env={"NOTIFY_SOCKET": str(path)}, timeout=60, check=True,
            cwd=Path(__file__).parents[2],
        )
