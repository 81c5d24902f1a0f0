"""Messages to systemd, or to another service manager that started the process."""

from __future__ import annotations

import contextlib
import os
import socket


def notify(*lines: str) -> None:
    """Send lines to systemd if systemd started this process; otherwise do nothing.

    Args:
        lines: lines such as ``READY=1`` and ``STATUS=all nodes are here``.
    """
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # an abstract socket
    # A service manager that restarts or is slow must not stop the process that it watches.
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto("\n".join(lines).encode(), address)
