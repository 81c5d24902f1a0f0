"""What a watcher costs a run: ``python tools/watch/disturbance.py [--turns N]``.

One run at full speed has turns of some seconds with a watcher and a reader of its page, and turns
without. The result is the ratio of the median times of a tick.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1])]

import paths  # noqa: F401
from graphs import Process, free_ports, reserved_domain, wait_for
from places import DATA

from greenroof_ros.watch import wire
from greenroof_ros.watch.graph_client import GraphClient

_TURN_S = 6.0


@contextmanager
def watched(domain: int, cwd: Path) -> Iterator[None]:
    """Run a watcher, and read its page's stream as a browser does."""
    port, count, ended = free_ports(1)[0], [0], threading.Event()
    process = Process(domain, "watch", "--port", str(port), cwd=cwd)
    wait_for(process.stdout, 60, "an address")

    def read() -> None:
        events = f"http://127.0.0.1:{port}/events?hours=12"
        with urllib.request.urlopen(events, timeout=60) as stream:
            while not ended.is_set():
                count[0] += len(stream.readline())

    threading.Thread(target=read, daemon=True).start()
    wait_for(lambda: count[0], 30, "what the page is sent")
    time.sleep(10)  # until it has read what was recorded before
    yield
    ended.set()
    process.process.terminate()
    process.wait(30)


class Ticks:
    """Learns a run's tick from /diagnostics alone, in the same way in both kinds of turns."""

    def __init__(self, domain: int) -> None:
        self.newest: tuple[float, int] | None = None
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:
        client = GraphClient("", self._on_message)
        while True:
            client.receive(0.1)

    def _on_message(self, topic: str, message: bytes, number: int | None, received_ns: int) -> None:
        _, statuses = wire.statuses(message) or (0, [])
        for status in statuses:
            if status.name == "/plant" and "tick" in status.values:
                self.newest = (received_ns / 1e9, int(status.values["tick"]))

    def measure(self) -> float:
        """Return the mean time of a tick over a turn (s)."""
        before = self._next()
        time.sleep(_TURN_S)
        after = self._next()
        return (after[0] - before[0]) / (after[1] - before[1])

    def _next(self) -> tuple[float, int]:
        old = self.newest
        wait_for(lambda: self.newest != old, 60, "a report of the plant")
        assert self.newest is not None
        return self.newest


def main() -> None:
    """Measure in turns, all in one run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--turns", type=int, default=5, help="default: %(default)s")
    turns = parser.parse_args().turns
    with ExitStack() as stack:
        domain = stack.enter_context(reserved_domain())
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        run = Process(  # it lasts longer than any measurement here
            domain, "bringup", "--controller", "mpc", "--weather",
            str(DATA / "en_climate_hourly_07-2021.csv"), "--evapotranspiration", "fao56",
            "--start", "2021-07-01", "--hours", "700", "--output", "run", cwd=place,
        )
        stack.callback(run.process.terminate)
        ticks = Ticks(domain)
        ticks_s: dict[bool, list[float]] = {False: [], True: []}
        for turn in range(2 * turns):
            with ExitStack() as watching:
                if turn % 2:
                    watching.enter_context(watched(domain, place))
                tick_s = ticks.measure()
            ticks_s[bool(turn % 2)].append(tick_s)
            print(f"{'with' if turn % 2 else 'without':8} {tick_s * 1e6:.0f} us a tick", flush=True)
            time.sleep(2)
        ratio = statistics.median(ticks_s[True]) / statistics.median(ticks_s[False])
        print(f"with a watcher {ratio:.3f} of without, medians of {turns} turns of {_TURN_S:g} s")


if __name__ == "__main__":
    main()
