"""Incidents of a run: each loss of a drive, a sensor or a node, from its start to its end."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

# The file's name in the directory of a run, next to the bag, and its name once it is full.
INCIDENTS = "incidents.jsonl"
_OLDER = f"{INCIDENTS}.1"
# Size at which the file is renamed, replacing the one before: over a thousand incidents (bytes).
_FULL = 1_000_000
# Name of the part that stands for a node's own process.
PROCESS = "process"

@dataclass(frozen=True)
class Incident:
    """A loss, and its end.

    Attributes:
        number: 1, 2, ... in the order of their beginning.
        node: the node that reported the loss, or that was lost.
        part: of the node, as in its diagnoses; ``process`` for the node itself.
        cause: in words, as at the start.
        began: wall time (UTC, ISO 8601).
        ended: wall time; None while it lasts.
        began_tick: in simulated time; None on a live site.
        ended_tick: in simulated time; None on a live site, and while it lasts.
        code: for programs; from :mod:`greenroof_ros.common.interface`.
    """

    number: int
    node: str
    part: str
    cause: str
    began: str
    ended: str | None = None
    began_tick: int | None = None
    ended_tick: int | None = None
    code: str = ""

    @property
    def subject(self) -> str:
        """What was lost: a node, or a part of one."""
        return self.node if self.part == PROCESS else f"{self.node}: {self.part}"

    @property
    def seconds(self) -> float | None:
        """How long it lasted in wall time (s); None while it lasts."""
        if self.ended is None:
            return None
        ended, began = map(datetime.fromisoformat, (self.ended, self.began))
        return (ended - began).total_seconds()


def read_incidents(directory: Path) -> list[Incident]:
    """Return the newest incidents of a run with a drive, or of a live site, in order of number.

    Each line of a file is an incident as it was known when the line was written; the last line with
    a number counts. Of each file, the last 2 MB are read.

    Args:
        directory: of the run. Without the files in it there was no incident.

    Raises:
        OSError: the file cannot be read.
        ValueError: a line is not an incident. An incomplete last line, cut by a crash, is ignored.
    """
    incidents: dict[int, Incident] = {}
    for path in (directory / _OLDER, directory / INCIDENTS):
        if path.exists():
            incidents |= {incident.number: incident for incident in _read(path)}
    return sorted(incidents.values(), key=lambda incident: incident.number)


def _read(path: Path) -> Iterator[Incident]:
    """Yield the incident of each of the last lines of a file."""
    with path.open("rb") as stream:
        skipped = max(0, path.stat().st_size - 2 * _FULL)
        stream.seek(skipped)
        if skipped:
            stream.readline()  # the rest of a line
        *lines, _cut = stream.read().split(b"\n")
    for index, line in enumerate(lines, start=1):
        try:
            yield Incident(**json.loads(line))
        except (ValueError, TypeError) as error:
            place = f"line {index} of its last 2 MB" if skipped else f"line {index}"
            raise ValueError(f"{path}, {place}: is not an incident ({error})") from error


def with_incidents(text: str, count: int) -> str:
    """Return how a run ended, with the number of incidents, if any."""
    if count == 0:
        return text
    return f"{text}, with {count} incident{'s' if count > 1 else ''}"
