"""Messages to systemd, or to another service manager that started the process."""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify(line: str) -> None:
    """Send a line, such as ``READY=1``, to systemd if systemd started this process."""
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # an abstract socket
    # A service manager that restarts or is slow must not stop the process that it watches.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(line.encode(), address)
