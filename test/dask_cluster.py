"""A Dask cluster of real processes on loopback."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from graphs import wait_for


class Dask:
    """A Dask scheduler and its workers, each a separate process, on loopback."""

    def __init__(self, directory: Path) -> None:
        file, self.log = directory / "scheduler.json", directory / "dask.log"
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start(
            "scheduler", "--port", "0", "--no-show", "--scheduler-file", str(file)
        )
        wait_for(lambda: file.is_file() and file.read_text().endswith("}"), 60, "a scheduler")
        self.address = json.loads(file.read_text())["address"]

    def start_worker(self) -> None:
        """Start another worker, and wait until the scheduler has it."""
        self.workers.append(
            self._start("worker", self.address, "--nthreads", "1", "--no-nanny")
        )
        self.wait_for_log("Register worker", len(self.workers))

    def _start(self, what: str, *options: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{what}", *options,
             "--host", "127.0.0.1", "--dashboard-address", ":0"],
            stdout=self.log.open("a"), stderr=subprocess.STDOUT,
        )

    def wait_for_log(self, words: str, times: int = 1) -> None:
        """Wait until the log has these words so many times."""
        wait_for(lambda: self.log.read_text().count(words) >= times, 60, f"{words!r} in a log")
