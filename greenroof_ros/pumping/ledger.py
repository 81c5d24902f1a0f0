"""What must survive a restart of the pump node: held, fault, and how much of the day is used up.

A JSON file, written whole to a second file that then takes the first one's name, so that a power
cut leaves the old or the new one. A thread of its own writes: a slow disk keeps the pump's control
from nothing.

The day is 24 h from the ledger's first step on. Time for which the node was down counts by the
system clock, if that did not go back.
"""

from __future__ import annotations

import json
import math
import os
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from greenroof_ros.pumping.settings import DAY_S

# At most so much of a day's use is lost when the node is killed (s).
_SAVE_EVERY = 60.0
# A disk that needs longer is an alarm (s).
_PATIENCE = 2.0


@dataclass(frozen=True)
class Record:
    """What is kept.

    Attributes:
        held: why the pump is held by somebody; empty where it is not.
        fault: the latched fault; empty where there is none.
        day_elapsed: of the present day (s).
        day_run: how long the pump was on in it (s).
        day_volume: what it pumped in it (m3).
        written_at: by the system clock (s since 1970).
    """

    held: str = ""
    fault: str = ""
    day_elapsed: float = 0.0
    day_run: float = 0.0
    day_volume: float = 0.0
    written_at: float = 0.0


class Ledger:
    """Keeps the record, in a file if there is one.

    A missing file is a fresh record. A broken one holds the pump until somebody releases it: what
    it said, be it a fault, is not known.

    Attributes:
        record: the present one.
        problem: why the file could not be written; empty where it could. Control goes on.
    """

    def __init__(self, file: Path | None, system_clock: Callable[[], float]) -> None:
        """Read the file.

        Args:
            file: where the record is kept; None keeps it in memory only.
            system_clock: gives s since 1970, such as :func:`time.time`.
        """
        self._file = file
        self._clock = system_clock
        self._unsaved = self._unwritten = 0.0
        self._lock = threading.Lock()
        self._to_write: Record | None = None
        self._writer: threading.Thread | None = None
        self.problem = ""
        self.record = Record()
        if file is not None:
            self.record = _read(file)
            down = system_clock() - self.record.written_at
            if self.record.written_at > 0 and down > 0:
                self._pass(down)

    def hold(self, reason: str) -> None:
        """Hold the pump, or release it (empty)."""
        self.record = replace(self.record, held=reason)
        self._save()

    def fault(self, text: str) -> None:
        """Latch a fault, or clear it (empty)."""
        self.record = replace(self.record, fault=text)
        self._save()

    def count(self, dt: float, run: float, volume: float) -> None:
        """Count the time that passed, that of it in which the pump was on (s), and m3 pumped."""
        self._pass(dt)
        self.record = replace(
            self.record,
            day_run=self.record.day_run + run, day_volume=self.record.day_volume + volume,
        )
        self._unsaved += dt
        if self._writer is None:
            self._unwritten = 0.0
            if self._unsaved >= _SAVE_EVERY:
                self._save()
        else:
            self._unwritten += dt
            if self._unwritten > _PATIENCE:
                self.problem = f"{self._file} could not be written within {_PATIENCE:g} s"

    def flush(self) -> None:
        """Wait until the record is on the disk, for a few seconds at most."""
        writer = self._writer
        if writer is not None:
            writer.join(_PATIENCE)

    def close(self) -> None:
        """Write the record a last time."""
        self._save()
        self.flush()

    def _pass(self, elapsed: float) -> None:
        elapsed += self.record.day_elapsed
        if elapsed >= DAY_S:
            self.record = replace(self.record, day_run=0.0, day_volume=0.0)
        self.record = replace(self.record, day_elapsed=elapsed % DAY_S)

    def _save(self) -> None:
        """Have the record written, after the one that is being written."""
        self._unsaved = 0.0
        if self._file is None:
            return
        with self._lock:
            self._to_write = replace(self.record, written_at=self._clock())
            if self._writer is None:
                # A daemon: the end of the process does not wait for a disk that hangs.
                writer = threading.Thread(
                    target=self._write_all, args=(self._file,), name="ledger", daemon=True
                )
                try:
                    self._writer = writer
                    writer.start()
                except RuntimeError as error:
                    self._writer = None
                    self.problem = f"{self._file} cannot be written: {error}"

    def _write_all(self, file: Path) -> None:
        while True:
            with self._lock:
                record, self._to_write = self._to_write, None
                if record is None:
                    self._writer = None
                    return
            self._write(file, record)

    def _write(self, file: Path, record: Record) -> None:
        beside = file.with_name(file.name + ".new")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            with beside.open("w") as stream:
                json.dump(asdict(record), stream, indent=1)
                stream.flush()
                os.fsync(stream.fileno())
            beside.replace(file)
            directory = os.open(file.parent, os.O_RDONLY)
            try:
                os.fsync(directory)
            finally:
                os.close(directory)
            self.problem = ""
        except OSError as error:
            self.problem = (
                f"{file} cannot be written: {error.strerror}; a restart would not know of a stop, "
                "a fault, and how much was pumped"
            )


def _read(file: Path) -> Record:
    """Read a record; a broken one is one that holds the pump."""
    try:
        content = json.loads(file.read_text())
        kinds = {key: type(value) for key, value in asdict(Record()).items()}
        if not isinstance(content, dict) or set(content) != set(kinds):
            raise ValueError(f"it must hold {', '.join(kinds)}")
        for key, value in content.items():
            kind = kinds[key]
            if kind is str and not isinstance(value, str):
                raise ValueError(f"{key} must be a text")
            if kind is float and not (
                type(value) in (int, float) and math.isfinite(value) and value >= 0
            ):
                raise ValueError(f"{key} must be a number, 0 or more")
        return Record(**content)
    except FileNotFoundError:
        return Record()
    except (OSError, ValueError, OverflowError, RecursionError) as error:
        return Record(
            held=f"{file} cannot be read ({error}), so whether there was a fault is not known; "
            "look at the pump, then release it"
        )
