"""What a service tells systemd: that it is ready, alive, stopping, and how it is.

The protocol of sd_notify(3) is a datagram of ``NAME=value`` lines to the socket that the
environment variable NOTIFY_SOCKET names: not enough to depend on a library for.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def notify(*lines: str) -> None:
    """Tell systemd, where it is what started this process; elsewhere nothing happens.

    Args:
        lines: such as ``READY=1`` and ``STATUS=all nodes are here``.
    """
    path = os.environ.get("NOTIFY_SOCKET")
    if not path:
        return
    address = f"\0{path[1:]}" if path.startswith("@") else path  # a socket without a file
    # A service manager that is restarted, or slow, must not stop what it watches.
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto("\n".join(lines).encode(), address)
