"""Measure the time and memory of districts: with one thread, with several, and on Dask here.

``python tools/district_times.py --weather DIR`` runs the example district with 100, 1,000 and
10,000 buildings in each of these ways, using the command that a user would type, and prints a
table. The processor time shows the cost of the work even if other programs use the machine.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import paths
from dask_cluster import Dask
from markdown_tables import head, row

EXAMPLE = paths.CHECKOUT / "config" / "districts" / "example.yaml"
THREADS, DASK = "thread(s)", "Dask worker(s)"
_SAMPLE_S = 0.2
_TICKS = os.sysconf("SC_CLK_TCK")


class Watched:
    """Watch the memory and processor time of some processes and of all processes they start."""

    def __init__(self, roots: list[int]) -> None:
        self._roots, self._end = roots, threading.Event()
        self.memory = 0.0
        """maximum memory of all processes together (MB)"""
        self._cpu: dict[int, float] = {}
        self._before = {process: _cpu_s(process) for process in self._tree()}
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    @property
    def cpu(self) -> float:
        """Processor time of all processes together since the start (s)."""
        return sum(seconds - self._before.get(one, 0.0) for one, seconds in self._cpu.items())

    def end(self) -> None:
        """Stop watching."""
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._end.wait(_SAMPLE_S):
            there = self._tree()
            self._cpu |= {process: _cpu_s(process) for process in there}
            self.memory = max(self.memory, sum(map(_proportional_mb, there)))

    def _tree(self) -> list[int]:
        found = [*self._roots]
        for process in found:
            for thread in Path(f"/proc/{process}/task").glob("*/children"):
                try:
                    found += map(int, thread.read_text().split())
                except OSError:
                    continue  # it has just ended
        return found


def _cpu_s(process: int) -> float:
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _proportional_mb(process: int) -> float:
    """Return the memory of a process, with a proportional part of what it shares (MB)."""
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    return sum(
        int(line.split()[1]) / 1000 for line in text.splitlines() if line.startswith("Pss:")
    )


@contextmanager
def cluster(workers: int, directory: Path) -> Iterator[Dask]:
    """Start a Dask cluster on this machine, and stop it at the end."""
    dask = Dask(directory)
    try:
        for _ in range(workers):
            dask.start_worker()
        yield dask
    finally:
        for process in (*dask.workers, dask.scheduler):
            process.kill()
            process.wait()


def measure(
    buildings: int, outlets: str, hours: int, way: str, count: int, weather: Path, directory: Path
) -> str:
    """Run a district once, write its results to a directory, and return a row of the table."""
    text = EXAMPLE.read_text(encoding="utf-8")
    for old, new in (
        ("buildings: 1000 ", f"buildings: {buildings} "),
        ("outlets: [none, orifice, drain, plan]", f"outlets: [{outlets}]"),
        ("hours: 4416", f"hours: {hours}"),
        ("site: house.yaml", f"site: {EXAMPLE.parent / 'house.yaml'}"),
    ):
        assert old in text
        text = text.replace(old, new)
    file = directory / "district.yaml"
    file.write_text(text, encoding="utf-8")
    command = [
        sys.executable, "-m", "greenroof_ros", "district", str(file), "--weather", str(weather),
        "--output", str(directory / "out"),
    ]

    def run(options: list[str], others: list[int]) -> str:
        begun = time.monotonic()
        with subprocess.Popen(
            [*command, *options], stdout=subprocess.DEVNULL, env={
                **os.environ, "PYTHONPATH": str(paths.CHECKOUT), "OMP_NUM_THREADS": "1",
            },
        ) as process:
            watched = Watched([process.pid, *others])
            code = process.wait()
            wall = time.monotonic() - begun
            watched.end()
        if code:
            sys.exit(f"exit code {code}")
        return row([
            f"{buildings:,}", outlets, f"{hours / 24:.0f}", f"{count} {way}", f"{wall:.0f} s",
            f"{watched.cpu:.0f} s", f"{watched.memory:.0f} MB",
        ])

    if way == THREADS:
        return run(["--jobs", str(count)], [])
    with cluster(count, directory) as dask:
        return run(
            ["--scheduler", dask.address],
            [dask.scheduler.pid, *(worker.pid for worker in dask.workers)],
        )


def main() -> None:
    """Run the measurements that the command line requests, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--weather", type=Path, required=True, help="directory of Toronto's files, YYYY_M.csv"
    )
    parser.add_argument("--buildings", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--outlets", nargs="+", default=["none, orifice, drain"])
    parser.add_argument("--hours", type=int, default=4416)
    parser.add_argument("--keep", type=Path, help="keep the results in this new directory")
    parser.add_argument("--ways", nargs="+", default=["1t", "2t", "2d"],
                        help="number of threads (t) or Dask workers (d)")
    arguments = parser.parse_args()
    columns = ["buildings", "outlets", "days", "on", "time", "processor time", "memory"]
    print(head(columns), flush=True)
    for outlets in arguments.outlets:
        for buildings in arguments.buildings:
            for way in arguments.ways:
                with tempfile.TemporaryDirectory() as scratch:
                    directory = Path(scratch)
                    print(measure(
                        buildings, outlets, arguments.hours,
                        THREADS if way[-1] == "t" else DASK, int(way[:-1]),
                        arguments.weather.resolve(), directory,
                    ), flush=True)
                    if arguments.keep is not None:
                        kept = f"{buildings}-{outlets.replace(', ', '-')}-{way}"
                        shutil.copytree(directory / "out", arguments.keep / kept)


if __name__ == "__main__":
    main()
