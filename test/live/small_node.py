"""A small node for the tests: without ROS, but with socket, signals and exit of a real node.

Its first argument states what it does, or has the names of several nodes with commas. Its second is
the directory ``marks`` with files by which a test observes and controls it.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path

from greenroof_ros import __version__

SOCKET = int(os.environ["GREENROOF_ROS_SUPERVISOR"])


def report(state: str, **values: object) -> None:
    content = {"state": state, "version": __version__, **values}
    os.write(SOCKET, (json.dumps(content) + "\n").encode())


def main() -> None:
    kind, marks = sys.argv[1], Path(sys.argv[2])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with (marks / "starts").open("a") as stream:
        stream.write(f"{kind} {os.getpid()} {time.monotonic()}\n")
    several = kind.split(",") if "," in kind else []
    print(f"{kind} {'were' if several else 'was'} started", flush=True)
    if kind == "wrong":
        report("ended", failure="parameter x must be a number")
        sys.exit(2)
    if kind == "fails":
        sys.exit(1)
    while kind in ("refuses", "crashes"):
        report("ready")
        time.sleep(0.05)
        if not (marks / "turn").exists():
            continue
        if kind == "crashes":
            ctypes.string_at(0)
        report("ended", failure="mine.py, line 3: x")
        sys.exit(2)
    while several:
        for node in several:
            waits = (marks / f"{node}-waits").exists()
            report("starting" if waits else "ready", node=node)
        time.sleep(0.05)
    while True:
        state = marks / f"{kind}-reports"
        numbers: dict[str, object] = {}
        if state.exists():
            numbers["pump_state"], numbers["pump_why"] = state.read_text().split(": ", 1)
        if (marks / f"{kind}-stands").exists():
            numbers["stands"] = json.loads((marks / f"{kind}-stands").read_text())
        report("starting" if (marks / f"{kind}-waits").exists() else "ready", **numbers)
        time.sleep(0.05)


main()
