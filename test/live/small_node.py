"""A small process for the tests: without ROS, but with heartbeat, signals and exit of a real one.

Its first argument states what it does. Its second is a file that exists while it reaches the drive.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

kind, reached = sys.argv[1], Path(sys.argv[2])
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
print(f"{kind} was started", file=sys.stderr, flush=True)
print(f"for people: {os.environ.get('GREENROOF_ROS_RESTARTED', '')}", flush=True)
if kind == "wrong":
    print("error: parameter x must be a number", file=sys.stderr)
    sys.exit(2)
if kind == "fails":
    sys.exit(1)
while True:
    os.write(int(os.environ["GREENROOF_ROS_HEARTBEAT"]), bytes([reached.exists()]))
    time.sleep(0.05)
