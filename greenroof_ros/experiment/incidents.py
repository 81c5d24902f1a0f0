"""Incidents of a run: each loss of a drive, a sensor or a node, from its start to its end."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.common.conditions import read_interlocks
from greenroof_ros.common.disk import DISK

# The file's name in the directory of a run, next to the bag, and its name once it is full.
INCIDENTS = "incidents.jsonl"
_OLDER = f"{INCIDENTS}.1"
# Size at which the file is renamed, replacing the one before: over a thousand incidents (bytes).
_FULL = 1_000_000
# Number kept in memory and in the summary; all are counted.
MOST = 200
# Name of the part that stands for a node's own process.
PROCESS = "process"

_LOST = frozenset({"ERROR", "STALE"})
_NOT_GOOD = _LOST | {"WARN"}


class Rule(NamedTuple):
    """When a part of a node is lost.

    Attributes:
        at: levels of its diagnosis at which it is lost.
        lasts_s: how long the loss must last to be an incident (s).
        follows: whether its loss usually follows from another loss: it is an incident only if
            nothing else is lost.
        stops_pump: whether no pump starts meanwhile; a running pump may go on.
    """

    at: frozenset[str] = _LOST
    lasts_s: float = 0.0
    follows: bool = False
    stops_pump: bool = True


# The parts of the pump node that report its inputs.
_PUMP_INPUTS = {interlock.input for interlock in read_interlocks().values()} - {""}
# By part, or by a code of its diagnosis, which has priority. A sensor's value counts for some
# seconds, so that one bad answer changes nothing; inputs count again some time after a loss.
_RULES = {
    **dict.fromkeys(("drive", "pump", "flow", "state file", "suspend"), Rule()),
    **dict.fromkeys(("recording", "disk"), Rule(stops_pump=False)),
    "sensor": Rule(lasts_s=3.0),
    **dict.fromkeys(
        ("forecast", "rain gauge", "thermometer", "gauge"),
        Rule(_NOT_GOOD, 3.0, stops_pump=False),
    ),
    **dict.fromkeys(("inputs", *_PUMP_INPUTS), Rule(lasts_s=30.0, follows=True)),
    "no_forecast": Rule(_NOT_GOOD, 30.0, follows=True, stops_pump=False),
}


class NodePart(NamedTuple):
    """A part of a node whose loss would be an incident, as last reported.

    Attributes:
        node: the node that reports it.
        name: of the part.
        diagnosis: as reported.
        rule: when it is lost.
    """

    node: str
    name: str
    diagnosis: Mapping[str, str]
    rule: Rule

    @property
    def is_lost(self) -> bool:
        """Whether it is lost now."""
        return self.diagnosis["level"] in self.rule.at


def parts_in(reports: Mapping[str, Mapping[str, Any]]) -> Iterator[NodePart]:
    """Yield the parts that are in the nodes' last reports."""
    for node, report in reports.items():
        for name, diagnosis in report.get("diagnoses", {}).items():
            rule = _RULES.get(diagnosis["code"]) or _RULES.get(name)
            if rule is not None:
                yield NodePart(node, name, diagnosis, rule)


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


class IncidentLog:
    """Finds incidents in the nodes' diagnoses, prints them and stores them.

    A drive in the loop and a live site share it, so that both report the same loss alike.

    Attributes:
        incidents: the newest ones.
        count: number of all incidents.
        changes: how often an incident began or ended.
    """

    def __init__(self, print_line: Callable[[str], None], file: Path | None = None) -> None:
        """Start without incidents.

        Args:
            print_line: prints a line for people.
            file: where the disk thread stores each change at once; None for nowhere.
        """
        self.incidents: deque[Incident] = deque(maxlen=MOST)
        self.count = self.changes = 0
        self._began = wall_time()
        self._before = 0  # number of the last incident from earlier starts in the file
        self._print_line = print_line
        self._file = file
        self._open: dict[tuple[str, str], Incident] = {}
        self._good: set[tuple[str, str]] = set()
        # Not lost for long enough yet: when first seen (steady clock, s), and the incident.
        self._pending: dict[tuple[str, str], tuple[float, Incident]] = {}

    @property
    def numbers(self) -> str:
        """The numbers of the incidents of this start, if there were others before it."""
        if not self._before or not self.count:
            return ""
        first, last = self._before + 1, self._before + self.count
        return f" since this start (number {first}" + (f" to {last})" if last > first else ")")

    @property
    def lasting(self) -> bool:
        """Whether anything is lost now."""
        return bool(self._open)

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return the newest incidents for a summary."""
        return [asdict(incident) for incident in self.incidents]

    def resume(self) -> None:
        """Continue the file of earlier starts; an incident that lasted then ends at this start.

        Raises:
            OSError: the file cannot be read or written.
            ValueError: it is damaged.
        """
        assert self._file is not None
        if self._file.exists():
            _drop_cut_line(self._file)
        for incident in read_incidents(self._file.parent):
            self._before = incident.number
            if incident.ended is None:
                self._store(replace(incident, ended=self._began))

    def update(
        self, reports: Mapping[str, Mapping[str, Any]], tick: int | None = None, *,
        starting: bool = False,
    ) -> None:
        """Start and end incidents according to the nodes' last reports.

        Args:
            reports: the last report of each node.
            tick: of simulated time; None on a live site.
            starting: only what was good before can be lost; the rest may not have started yet.
        """
        for part in parts_in(reports):
            about = part.node, part.name
            if part.diagnosis["level"] == "OK":
                self._good.add(about)
            if not part.is_lost:
                self._pending.pop(about, None)
                self.end(*about, tick)
            elif about not in self._open and (not starting or about in self._good):
                self._suspect(about, part, tick)

    def _suspect(self, about: tuple[str, str], part: NodePart, tick: int | None) -> None:
        """Start an incident once it has lasted long enough."""
        now = time.monotonic()
        cause, began = part.diagnosis["message"], wall_time()
        if tick is None and about not in self._good:
            cause, began = f"since the start: {cause}", self._began
        first_seen, incident = self._pending.setdefault(about, (now, Incident(
            0, *about, cause, began, began_tick=tick, code=part.diagnosis["code"],
        )))
        if part.rule.follows and self.lasting:
            self._pending.pop(about)
        elif now - first_seen >= part.rule.lasts_s:
            del self._pending[about]
            self._start(incident)

    def fail(self, node: str, cause: str) -> None:
        """Start the incident of a node's own process, and end its earlier one, if any."""
        self.end(node, PROCESS)
        self._start(Incident(0, node, PROCESS, cause, wall_time(), code="node_failed"))

    def _start(self, incident: Incident) -> None:
        self.count += 1
        incident = replace(incident, number=self._before + self.count)
        self._open[incident.node, incident.part] = incident
        self.incidents.append(incident)
        self._store(incident)
        at = "" if incident.began_tick is None else f" at tick {incident.began_tick}"
        self._print_line(f"incident {incident.number}{at}: {incident.node}: {incident.cause}")

    def end(self, node: str, part: str, tick: int | None = None) -> None:
        """End the incident of a part, if there is one."""
        before = self._open.pop((node, part), None)
        if before is None:
            return
        incident = replace(before, ended=wall_time(), ended_tick=tick)
        if before in self.incidents:
            self.incidents[self.incidents.index(before)] = incident
        self._store(incident)
        at = "" if tick is None else f" at tick {tick}"
        self._print_line(
            f"incident {incident.number} is over{at}, after {incident.seconds:.1f} s: "
            f"{incident.subject}"
        )

    def _store(self, incident: Incident) -> None:
        self.changes += 1
        if self._file is not None:
            DISK.do(partial(self._write, self._file, incident, tuple(self._open.values())))

    def _write(self, file: Path, incident: Incident, lasting: Sequence[Incident]) -> None:
        """Write an incident on the disk thread; if the file is full, begin a new one.

        A new file begins with what still lasts, so that this is never lost. A full disk stops
        nothing: the summary has the incident, too.
        """
        written = [incident]
        try:
            if file.exists() and file.stat().st_size >= _FULL:
                file.replace(file.with_name(_OLDER))
                written = [*lasting, incident]
            with file.open("a", encoding="utf-8") as stream:
                stream.writelines(f"{json.dumps(asdict(entry))}\n" for entry in written)
        except OSError as error:
            self._print_line(f"warning: {file}: {error.strerror}")


def _drop_cut_line(file: Path) -> None:
    """Remove the end of a file after its last complete line, which a crash has cut."""
    with file.open("rb+") as stream:
        start = max(0, file.stat().st_size - _FULL)
        stream.seek(start)
        stream.truncate(start + stream.read().rfind(b"\n") + 1)


def with_incidents(text: str, count: int) -> str:
    """Return how a run ended, with the number of incidents, if any."""
    if count == 0:
        return text
    return f"{text}, with {count} incident{'s' if count > 1 else ''}"


def wall_time() -> str:
    """Return the present time in the form of an incident's times (UTC, ISO 8601)."""
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")
