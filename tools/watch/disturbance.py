"""What watchers cost a run: ``python tools/watch/disturbance.py tick|stops|memory``.

- ``tick``: in one run at full speed, turns of some seconds with a watcher and without; the ratio
  of the medians of a tick's time.
- ``stops``: the watcher's process stopped for 6 s a hundred times, beside a run at 30 times real
  time; its bag must equal the bag of a run that nobody watched, byte for byte.
- ``memory``: of the watcher, beside a run at full speed for an hour.
"""

from __future__ import annotations

import argparse
import filecmp
import math
import os
import shutil
import signal
import statistics
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(CHECKOUT / "test"), str(CHECKOUT)]

from graphs import Process, bag_file, bring_up, free_ports, own_domain, wait_for  # noqa: E402
from places import DATA  # noqa: E402

from greenroof_ros.graph.looker import Looker  # noqa: E402
from greenroof_ros.watch import wire  # noqa: E402

STOP_S, BETWEEN_S = 6.0, 1.0


@contextmanager
def watcher(domain: int, cwd: Path, *options: str) -> Iterator[tuple[Process, str]]:
    """Start one and yield it with its page's address; end it."""
    process = Process(domain, "watch", "--port", str(free_ports(1)[0]), *options, cwd=cwd)
    try:
        address = wait_for(lambda: _address(process), 60, "an address")
        yield process, address
    finally:
        process.process.send_signal(signal.SIGCONT)
        process.process.terminate()
        process.wait(30)


def _address(process: Process) -> str:
    words = process.stdout().split()
    return next((word for word in words if word.startswith("http://")), "")


@contextmanager
def client(address: str) -> Iterator[list[int]]:
    """Read the page's stream as a browser does; yields how many bytes came, in a list of one."""
    count, ended = [0], threading.Event()

    def read() -> None:
        events = f"{address}events?hours=12"
        with urllib.request.urlopen(events, timeout=60) as stream:  # noqa: S310 - the page's own
            while not ended.is_set():
                count[0] += len(stream.readline())

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    wait_for(lambda: count[0], 30, "what the page is told")
    yield count
    ended.set()


def _rss_mb(pid: int) -> float:
    text = Path(f"/proc/{pid}/status").read_text()
    return int(text.partition("VmRSS:")[2].split()[0]) / 1024


class Ticks:
    """Hears by /diagnostics alone at which tick a run is, in both kinds of turns."""

    def __init__(self, domain: int) -> None:
        self.newest: tuple[float, int] | None = None
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        self._ended = False
        self._thread = threading.Thread(target=self._hear, daemon=True)
        self._thread.start()

    def _hear(self) -> None:
        looker = Looker("", self._on_message)
        while not self._ended:
            looker.look(0.1)
        looker.close()

    def _on_message(self, topic: str, message: bytes, number: int | None, came_ns: int) -> None:
        told = wire.statuses(message)
        for status in () if told is None else told[1]:
            if status.name == "/plant" and "tick" in status.values:
                self.newest = (came_ns / 1e9, int(status.values["tick"]))

    def measure(self, seconds: float) -> float:
        """Return the time of a tick over so long (s)."""
        before = self._next()
        time.sleep(seconds)
        after = self._next()
        return (after[0] - before[0]) / (after[1] - before[1])

    def _next(self) -> tuple[float, int]:
        old = self.newest
        wait_for(lambda: self.newest != old, 30, "a report of the plant")
        assert self.newest is not None
        return self.newest

    def close(self) -> None:
        """End hearing."""
        self._ended = True
        self._thread.join(5)


def tick(turns: int, seconds: float) -> None:
    """Measure a tick with a watcher and one reader, and without, in turns in one run."""
    with ExitStack() as stack:
        domain = stack.enter_context(own_domain())
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        run = long_run(domain, place)
        stack.callback(run.process.terminate)
        ticks = Ticks(domain)
        stack.callback(ticks.close)
        wait_for(lambda: ticks.newest, 60, "a running graph")
        time.sleep(5)
        found: dict[bool, list[float]] = {False: [], True: []}
        for turn in range(2 * turns):
            with ExitStack() as watching:
                if turn % 2:
                    _, address = watching.enter_context(watcher(domain, place))
                    watching.enter_context(client(address))
                    time.sleep(10)  # it has read what was recorded before
                took = ticks.measure(seconds)
            found[bool(turn % 2)].append(took)
            print(f"{'with' if turn % 2 else 'without':8} {took * 1e6:.0f} us a tick", flush=True)
            time.sleep(2)
        ratio = statistics.median(found[True]) / statistics.median(found[False])
        print(f"with a watcher {ratio:.3f} of without, medians of {turns} turns of {seconds:g} s")


def long_run(domain: int, place: Path) -> Process:
    """Start a run at full speed that lasts longer than any measurement here."""
    return Process(
        domain, "bringup", "--controller", "mpc", "--weather",
        str(DATA / "en_climate_hourly_07-2021.csv"), "--evapotranspiration", "fao56",
        "--start", "2021-07-01", "--hours", "700", "--output", "run", cwd=place,
    )


def stops(count: int, hours: float) -> None:
    """Stop the watcher's process again and again, beside a run at 30 times real time.

    Compare the run's bag with an unwatched run's.
    """
    options = ("--hours", f"{hours:g}", "--controller", "mpc")
    with ExitStack() as stack:
        domain = stack.enter_context(own_domain())
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        run = Process(
            domain, "bringup", *options, "--speed", "30", "--output", "run", cwd=place
        )
        run.wait_for_ticks(1000)
        process, _ = stack.enter_context(watcher(domain, place))
        done = 0
        while done < count and run.process.poll() is None:
            process.process.send_signal(signal.SIGSTOP)
            time.sleep(STOP_S)
            process.process.send_signal(signal.SIGCONT)
            time.sleep(BETWEEN_S)
            done += 1
        code = run.wait(7200)
        bring_up(domain, place, *options, output="alone", seconds=3600)
        equal = filecmp.cmp(bag_file(place / "run"), bag_file(place / "alone"), shallow=False)
        print(f"{done} stops of {STOP_S:g} s: the run ended with exit code {code}, its bag is "
              f"{'byte-equal' if equal else 'ANOTHER'}")
        if code or not equal:
            print(run.stderr())
            sys.exit(1)


def memory(minutes: float) -> None:
    """Print the watcher's memory beside a run at full speed, quarter by quarter."""
    with ExitStack() as stack:
        domain = stack.enter_context(own_domain())
        place = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        run = long_run(domain, place)
        stack.callback(lambda: run.process.terminate())
        run.wait_for_ticks()
        process, address = stack.enter_context(watcher(domain, place))
        stack.enter_context(client(address))
        sizes = []
        until = time.monotonic() + 60 * minutes
        while time.monotonic() < until:
            if run.process.poll() is not None:  # a month is over: the next
                shutil.rmtree(place / "run")
                run = long_run(domain, place)
            # With the process that reads the bag.
            tasks = Path(f"/proc/{process.process.pid}/task")
            children = [int(each) for file in tasks.glob("*/children")
                        for each in file.read_text().split()]
            sizes.append(sum(map(_rss_mb, (process.process.pid, *children))))
            time.sleep(2)
        quarter = len(sizes) // 4
        parts = [statistics.mean(sizes[n * quarter:(n + 1) * quarter]) for n in range(4)]
        print(f"memory over {minutes:g} min, quarters: {', '.join(f'{p:.1f}' for p in parts)} MB, "
              f"greatest {max(sizes):.1f}")


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["tick", "stops", "memory"])
    parser.add_argument("--turns", type=int, default=5, help="of tick (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=6.0, help="of a turn (default: 6)")
    parser.add_argument("--count", type=int, default=100, help="of stops (default: %(default)s)")
    parser.add_argument("--hours", type=float, help="simulated, of stops")
    parser.add_argument("--minutes", type=float, default=60.0, help="of memory (default: 60)")
    arguments = parser.parse_args()
    if arguments.what == "tick":
        tick(arguments.turns, arguments.seconds)
    elif arguments.what == "stops":
        lasts = arguments.count * (STOP_S + BETWEEN_S) + 30
        whole = math.ceil(lasts * 30 / 36) / 100  # hours, of whole ticks
        stops(arguments.count, arguments.hours or whole)
    else:
        memory(arguments.minutes)


if __name__ == "__main__":
    main()
