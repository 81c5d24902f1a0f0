"""The state file: what must survive a restart, that is, hold, fault, starts and usage in 24 h.

A hold keeps the pump off. The owner of a hold is whoever requested it; its reason may be empty, and
it may have no end. The state file promises:

- The hold is read before the pump may run. It survives restarts and power cuts.
- There is one hold at a time. A later request replaces its owner and reason, but never shortens it:
  the later end applies, and a hold without an end counts as the latest.
- A hold ends at the specified time on the system clock, or when anyone releases it.
- If it is unknown whether there was a hold or a fault, this is a latched fault: the pump stays off
  until someone who has checked the pump clears it.

The file has two lines, each with its checksum, its number, and the state as JSON, padded with
blanks to one page. They are overwritten in turn, in place, so a hold or a fault can be saved even
if the disk later becomes full (except on file systems that never write in place: btrfs, zfs).
Killing the process does not tear a page, but a power cut may. The other line is then intact, but
the torn line may have contained a hold or a fault, so it is unknown whether there was one. Holds
and faults are also unknown if the file cannot be read, has another format, is an older copy or that
of another site, or is missing while the file ``.number`` next to it shows that there was one. That
file contains the number of the last line; the first number is random, so the numbers differ between
sites. If the files are removed while a process uses them, it makes them anew within a minute.
A process that is killed in that minute forgets what they contained.

The disk thread writes the file, so a slow disk does not delay the control of the pump. Only one
process of a machine uses the file.

Usage is counted in half-hour slots over the last 24 h of a clock that follows the computer's steady
clock, whether or not the node is running. Time before the computer's start is not added, since it
is unknown whether the system clock was correct then. The oldest slot counts in full until all of it
is more than 24 h old.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import time
import zlib
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime, timezone, tzinfo
from pathlib import Path
from socket import socket
from typing import Any

from greenroof_ros.base.disk import DISK, PATIENCE_S
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import replace_file, replace_text
from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.base.times import boot_id, boot_time, clock_time
from greenroof_ros.interface.conditions import Diagnosis

DAY_S = 86_400.0
GUARD = "pump_guard"
"""name of the node that keeps the file if the user's own node runs the pump"""
SAVE_EVERY_S = 10.0
"""While the pump is on, at most this much of its use is not yet on the disk (s)."""
_SAVE_OFF_S = 60.0  # as it is while the pump is off, in case that the files were removed
MAX_TIME = 1e11
"""No hold ends later (s since 1970)."""
# Length of a slot (s), and the number of slots that the last 24 h touch.
_SLOT_S, _SLOTS = 1800.0, 49
# Length of a line (bytes): a page, and a block of most disks.
_LINE = 4096
# How many starts are remembered, since no pump may start more often in the hour that counts, and
# how many of them a line contains.
_MAX_STARTS, _SAVED_STARTS = 3600, 100
# The texts that people write or read, and the maximum length of each.
_TEXTS, _MAX_TEXT = {"hold_owner", "hold_reason", "fault"}, 350
# The format of the file, which changes with the keys and their meanings.
_VERSION = 2
# The number next to the file may be behind by this much: each kill between the two adds 1.
_UNNOTED = 10_000
# A service waits this long for the disk (s), well below the silence after which a node is killed.
_WAIT_S = 0.5


@dataclass(frozen=True)
class StoredState:
    """What the state file contains.

    Attributes:
        hold_owner: owner of the hold; empty if there is no hold.
        hold_reason: reason for the hold; may be empty.
        hold_since: time of the request for the hold (s since 1970); None if unknown.
        hold_until: end of the hold on the system clock (s since 1970); None if it has no end.
        fault: the latched fault; empty if there is none.
        fault_code: code of the fault's interlock.
        elapsed: time since the file was created (s), on the clock that the module describes.
        volumes: pumped volume (m3) in each of the last slots of ``elapsed``, the current one last.
        starts: times of the pump's last starts (s, as in ``elapsed``); the file contains the last
            hundred.
        on: whether the pump was on when the state was saved.
        without_rain: for the valve, time without rain (s), up to when the state was saved.
        boot: identifier of the computer's boot after which the state was saved; empty if unknown.
        boot_s: time from that boot until the state was saved (s).
    """

    hold_owner: str = ""
    hold_reason: str = ""
    hold_since: float | None = None
    hold_until: float | None = None
    fault: str = ""
    fault_code: str = ""
    elapsed: float = 0.0
    volumes: tuple[float, ...] = ()
    starts: tuple[float, ...] = ()
    on: bool = False
    without_rain: float = 0.0
    boot: str = ""
    boot_s: float = 0.0

    @property
    def since_start(self) -> float:
        """Time since the last start (s); infinite if there was none."""
        return self.elapsed - self.starts[-1] if self.starts else math.inf

    @property
    def day_volume(self) -> float:
        """Volume that was pumped or released in the last 24 h (m3)."""
        return math.fsum(self.volumes)

    def clears_in(self, limit: float) -> float:
        """Return the time (s) until the volume in 24 h is below a limit (m3)."""
        kept = len(self.volumes)
        while math.fsum(self.volumes[len(self.volumes) - kept:]) >= limit:
            kept -= 1
        last_out = self.elapsed // _SLOT_S - kept  # the last slot that must drop out
        return max(0.0, (last_out + _SLOTS) * _SLOT_S - self.elapsed)


class StateFile:
    """A pump's state, kept in a file if a file is specified.

    Attributes:
        file: the file; None if the state is kept in memory only.
        state: the current state.
        problem: reason why the file could not be written; empty if it was written. Control
            continues regardless.
        saved: whether the state has been saved since the start.
        unseen_s: time between the last state of an earlier process and this start (s); infinite if
            it is unknown.
    """

    def __init__(self, file: Path | None, zone: tzinfo = timezone.utc) -> None:
        """Read the file, and create it if it is missing.

        Args:
            file: the file; None to keep the state in memory only.
            zone: time zone in which the times of a hold are shown.

        Raises:
            ConfigurationError: if another process uses the file.
        """
        self.state = StoredState()
        self.file, self.problem, self.saved = file, "", file is None
        self._zone = zone
        # The latest state to write, the last one that was written, the number of its line, and
        # whether the file was whole when it was read.
        self._latest = self._written = self.state
        self._number, self._whole = 0, False
        self.unseen_s = 0.0
        self._lock: socket | None = None
        if file is not None:
            try:
                self._lock = acquire_name_lock(os.path.realpath(file))
            except (LockedError, OSError) as error:
                raise ConfigurationError(
                    f"cannot be used: {error}", key="state_file", value=str(file)
                ) from None
            self._load(file)
            self.save()

    # --- hold and fault ---------------------------------------------------------------------------

    @property
    def active_hold(self) -> Diagnosis | None:
        """Owner, start, end and reason of the hold as a diagnosis; None if there is no hold."""
        state, ends = self.state, self.state.hold_until
        if not state.hold_owner or (ends is not None and time.time() >= ends):
            return None
        known, now = {"owner": state.hold_owner}, datetime.fromtimestamp(time.time(), self._zone)
        for name, at in ("since", state.hold_since), ("until", ends):
            if at is not None:
                known[name] = clock_time(datetime.fromtimestamp(at, self._zone), now)
        if state.hold_reason:
            known["reason"] = state.hold_reason
        return Diagnosis.of("hold", *known, **known)

    def hold(self, owner: str, reason: str = "", until: float | None = None) -> bool:
        """Keep the pump off until a release, or until a time (s since 1970) if one is specified.

        Returns:
            False if the hold ends later than specified, because an earlier hold does.
        """
        ends = [until, self.state.hold_until] if self.active_hold else [until]
        last = None if None in ends else max(end for end in ends if end is not None)
        self.change(
            hold_owner=owner, hold_reason=reason, hold_since=time.time(), hold_until=last,
        )
        return last == until

    def release(self) -> None:
        """End the hold, regardless of its owner."""
        self.change(hold_owner="", hold_reason="", hold_since=None, hold_until=None)

    def change(self, **changes: Any) -> None:
        """Change fields of the state, and save it; an empty ``fault`` clears that."""
        for name in _TEXTS & changes.keys():
            changes[name] = changes[name][:_MAX_TEXT]
        self.state = replace(self.state, **changes)
        self.save()

    # --- starts and usage -------------------------------------------------------------------------

    def switch(self, on: bool) -> None:
        """Record that the pump was started or stopped."""
        starts = (*self.state.starts, self.state.elapsed) if on else self.state.starts
        self.change(on=on, starts=starts[-_MAX_STARTS:])

    def count(self, dt: float, volume: float) -> None:
        """Add elapsed time (s), and the volume that was pumped within it (m3)."""
        before, now = self.state.elapsed, self.state.elapsed + dt
        new = min(int(now // _SLOT_S - before // _SLOT_S), _SLOTS)
        *earlier, present = (*(self.state.volumes or (0.0,)), *[0.0] * new)[-_SLOTS:]
        self.state = replace(self.state, elapsed=now, volumes=(*earlier, present + volume))

    def count_unseen(self, max_run: float, flow: float) -> None:
        """Add the worst-case usage after a node that ended before it had confirmed the pump off.

        Args:
            max_run: longest time for which the pump may have run since the state was saved (s).
            flow: maximum flow (m3/s).
        """
        if self.state.on:
            self.count(0.0, min(self.unseen_s, max_run) * flow)
            self.switch(False)

    # --- writing ----------------------------------------------------------------------------------

    def save(self) -> None:
        """Queue the state for writing, after any write in progress."""
        self._latest = replace(self.state, boot=boot_id(), boot_s=boot_time())
        self.check()

    def check(self) -> None:
        """Write the state if that is due, or was not possible before; to be called every second."""
        if boot_time() - self._latest.boot_s >= (SAVE_EVERY_S if self.state.on else _SAVE_OFF_S):
            self.save()
        if self._lock is not None and self._latest is not self._written:
            DISK.do(self._write)
            if DISK.late:
                self.problem = f"{self.file} could not be written within {PATIENCE_S:g} s"
                if self._written is self._latest:  # it has just been written
                    self.problem = ""

    def flush(self, within: float = _WAIT_S) -> str:
        """Write the state, and return the reason if it is not on the disk, or else an empty text.

        Args:
            within: maximum time to wait for the disk (s); the write continues after that.
        """
        self.save()
        if self._lock is None or (DISK.wait(within) and self._written is self._latest):
            return ""
        return self.problem or f"{self.file} is not yet on the disk; writing continues"

    def close(self) -> str:
        """Write the state and release the file; return the reason if it is not on the disk."""
        problem = self.flush(PATIENCE_S)
        if self._lock is not None and DISK.wait(0.0):
            self._lock.close()
            self._lock = None
        return problem

    def _write(self) -> None:
        """Write the latest state into the next line, or into a new file; by the disk thread."""
        assert self.file is not None
        file, state, number = self.file, self._latest, self._number + 1
        try:
            if self._whole and file.exists() and _number_file(file).exists():
                _overwrite(file, _LINE * ((number + 1) % 2), _format(number, state))
                _overwrite(_number_file(file), 0, b"%-24d\n" % number)
            else:
                content = 2 * _format(number, state)
                replace_file(file, lambda stream: stream.write(content), parents=True)
                replace_text(_number_file(file), f"{number:<24}\n")
                directory = os.open(file.parent, os.O_RDONLY)
                os.fsync(directory)
                os.close(directory)
            self._number, self._whole = number, True
            self._written, self.problem, self.saved = state, "", True
        except OSError as error:
            self.problem = (
                f"{file} cannot be written: {error.strerror}; after a restart, holds, faults "
                "and the pumped volume would be unknown"
            )

    # --- reading ----------------------------------------------------------------------------------

    def _load(self, file: Path) -> None:
        """Read the file, and add the time since it was written."""
        lines, problems, noted = dict[int, StoredState](), list[str](), _read_number(file)
        try:
            content = file.read_bytes()
            if len(content) != 2 * _LINE:
                problems.append(f"it must be {2 * _LINE} bytes long")
            for number in (1, 2):
                try:
                    lines |= _parse(content[_LINE * (number - 1) : _LINE * number])
                except Exception as error:  # whatever it is, the line may have contained a hold
                    problems.append(f"line {number}: {error}")
        except OSError as error:
            # A site that has never run has neither file.
            if not isinstance(error, FileNotFoundError) or noted is not None:
                problems.append(str(error.strerror))
        self._number = max(lines, default=noted or secrets.randbelow(2**44))
        state = lines.get(self._number, StoredState())
        if noted and not problems and not 0 <= self._number - noted <= _UNNOTED:
            problems, self._number = ["it is an older copy, or belongs to another site"], noted
        if problems:
            why = (
                f"{file} cannot be read ({'; '.join(problems)}), so it is unknown whether there "
                "was a hold or a fault; check the pump, then reset the fault"
            )
            before = f"; before, {state.fault}" if state.fault else ""
            state = replace(state, fault_code="state_unknown", fault=why + before)
        self.state, self._whole = state, noted is not None and not problems
        self.unseen_s = math.inf
        if state.boot == boot_id():
            self.unseen_s = boot_time() - state.boot_s
            self.count(self.unseen_s, 0.0)


def _number_file(file: Path) -> Path:
    return file.with_name(f"{file.name}.number")


def _read_number(file: Path) -> int | None:
    """Return the number of the last line that was written; None without one, 0 if unknown."""
    try:
        return int(_number_file(file).read_text())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return 0


def _overwrite(file: Path, start: int, content: bytes) -> None:
    """Write bytes at a place in an existing file.

    They fit in the stream's buffer, and so are written by one call, which no kill interrupts.

    Raises:
        OSError: if the disk is full or fails.
    """
    with file.open("r+b", buffering=2 * _LINE) as stream:
        stream.seek(start)
        stream.write(content)
        stream.flush()
        os.fdatasync(stream.fileno())


def _parse(line: bytes) -> dict[int, StoredState]:
    """Return the state in a line, by its number.

    Raises:
        Exception: of any type, if the line is damaged or has another format.
    """
    checksum, _, text = line.rstrip().partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        raise ValueError("its checksum is wrong")
    content = json.loads(text)
    if content["version"] == 1:  # of an earlier version of this package
        content.setdefault("hold_since", None)
        content.setdefault("volumes", [volume for _, volume in content.get("use", ())])
        if content["unknown"]:
            told = [content["unknown"], content["fault"]]
            content |= {"fault": "; ".join(filter(None, told)), "fault_code": "state_unknown"}
    content.setdefault("without_rain", 0.0)
    if content["version"] not in (1, _VERSION):
        raise ValueError(f"its format is {content['version']}, but this version reads {_VERSION}")
    state = StoredState(**{field.name: content[field.name] for field in fields(StoredState)})
    return {content["sequence"]: replace(
        state, volumes=tuple(state.volumes), starts=tuple(state.starts)
    )}


def _format(number: int, state: StoredState) -> bytes:
    """Return a line; texts are cut and numbers are rounded, so that any state fits."""
    content = {"version": _VERSION, "sequence": number, **asdict(state)}
    content["volumes"] = [float(f"{volume:.6g}") for volume in state.volumes]
    content["starts"] = [round(start, 1) for start in state.starts[-_SAVED_STARTS:]]
    while True:
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
        line = text.encode(errors="replace")
        if len(line) < _LINE - 10:
            return (b"%08x %b" % (zlib.crc32(line), line)).ljust(_LINE - 1) + b"\n"
        longest = max(_TEXTS, key=lambda name: len(content[name]))
        content[longest] = content[longest][:-10]
