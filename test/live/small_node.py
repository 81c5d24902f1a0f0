"""A small process for the tests: without ROS, but with heartbeat, signals and exit of a real one.

Its first argument states what it does. Its second is the directory ``marks`` with files by which a
test observes and controls it.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from pathlib import Path

READY, AT_REST = 1, 2


def beat(state: int) -> None:
    os.write(int(os.environ["GREENROOF_ROS_HEARTBEAT"]), bytes([state]))


def main() -> None:
    kind, marks = sys.argv[1], Path(sys.argv[2])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with (marks / "starts").open("a") as stream:
        stream.write(f"{kind} {os.getpid()} {time.monotonic()}\n")
    print(f"{kind} was started", file=sys.stderr, flush=True)
    if kind == "station":
        print(f"for people: {os.environ.get('GREENROOF_ROS_RESTARTED', '')}", flush=True)
    if kind == "wrong":
        print("error: parameter x must be a number", file=sys.stderr)
        sys.exit(2)
    if kind == "fails":
        sys.exit(1)
    while kind in ("refuses", "crashes"):
        beat(READY)
        time.sleep(0.05)
        if not (marks / "turn").exists():
            continue
        if kind == "crashes":
            ctypes.string_at(0)
        print("error: mine.py, line 3: x", file=sys.stderr)
        sys.exit(2)
    while True:
        at_rest = AT_REST if (marks / f"{kind}-rests").exists() else 0
        beat(at_rest | (0 if (marks / f"{kind}-waits").exists() else READY))
        time.sleep(0.05)


main()
