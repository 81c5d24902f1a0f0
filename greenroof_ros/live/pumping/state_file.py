"""The state file: what must survive a restart, that is, hold, fault, starts and usage in 24 h.

A hold keeps the pump off. The owner of a hold is whoever requested it; its reason may be empty, and
it may have no end. The state file promises:

- The hold is read before the pump may run. It survives restarts and power cuts.
- There is one hold at a time. A later request replaces its owner and reason, but never shortens it:
  the later end applies, and a hold without an end counts as the latest.
- A hold ends at the specified time on the system clock, or when anyone releases it.
- If it is unknown whether there was a hold or a fault, the pump stays off until someone who has
  checked the pump clears this state.

The file has two lines, each with its checksum, its number, and the state as JSON, padded with
blanks to one page. They are overwritten in turn, in place, so a hold or a fault can be saved even
if the disk later becomes full (except on file systems that never write in place: btrfs, zfs).
Killing the process does not tear a page, but a power cut may. The other line is then intact, but
the torn line may have contained a hold or a fault, so it is unknown whether there was one. Holds
and faults are also unknown if the file cannot be read, has another format, is an older copy or that
of another site, or is missing while another file shows that there was one. To detect a copy, the
file ``.number`` next to it contains the number of the last line; the first number is random, so the
numbers differ between sites.

The disk thread writes the file, so a slow disk does not delay the control of the pump. Only one
process of a machine uses the file. It is created under another name, then renamed, also if another
program has removed or changed it.

Usage is counted in half-hour slots over the last 24 h of a clock that follows the computer's steady
clock, whether or not the node is running. Time before the computer's start is not added, since it
is unknown whether the system clock was correct then. The oldest slot counts in full until all of it
is more than 24 h old.
"""

from __future__ import annotations

import errno
import json
import math
import os
import secrets
import stat
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone, tzinfo
from itertools import chain
from pathlib import Path
from socket import socket
from typing import Any

from greenroof_ros.base.disk import DISK, PATIENCE_S
from greenroof_ros.base.files import replace_file
from greenroof_ros.base.processes import LockedError, acquire_name_lock
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import to_people
from greenroof_ros.interface.alarm import ALARMS
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.boot_clock import boot_id, boot_time

DAY_S = 86_400.0
STATE_FILE = "pump.json"
"""the file's name in the directory of a live site"""
GUARD = "pump_guard"
"""name of the node that keeps the file if the user's own node runs the pump"""
SAVE_EVERY_S = 10.0
"""While the pump is on, at most this much of its time on is not yet on the disk (s)."""
MAX_NUMBER = 1e11
"""No number in the file is larger; as a time, it is in the year 5138."""
_NUMBER = Range(0.0, MAX_NUMBER)
# What a live site writes next to its state file.
_OF_SITE = ("summary.json", ALARMS, "bag", "configuration")
# Length of a slot (s), and the number of slots that the last 24 h touch.
_SLOT_S, _SLOTS = 1800.0, 49
# Length of a line (bytes): a page, and a block of most disks.
_LINE = 4096
# How many starts are remembered, since no pump may start more often in the hour that counts, and
# how many of them a line contains.
_MAX_STARTS, _SAVED_STARTS = 3600, 100
# The texts in a line, and the maximum length of a user's text.
_TEXTS = "hold_owner", "hold_reason", "unknown", "fault", "fault_code", "boot"
_MAX_TEXT = 350
# The format of the file. In another one, a key has another meaning; a new key does not change it.
_VERSION = 1
# The number next to the file may be behind by this much: each kill between the two adds up to 2.
_UNNOTED = 10_000
# A service waits this long for the disk (s), well below the silence after which a node is killed.
_WAIT_S = 0.5


@dataclass(frozen=True)
class StoredState:
    """What the state file contains.

    Attributes:
        hold_owner: owner of the hold; empty if there is no hold.
        hold_reason: reason for the hold; may be empty.
        hold_until: end of the hold on the system clock (s since 1970); None if it has no end.
        unknown: reason why it is unknown whether there was a hold or a fault; empty if this is
            known.
        fault: the latched fault; empty if there is none.
        fault_code: code of the fault's interlock.
        elapsed: time since the file was created (s), on the clock that the module describes.
        use: time on (s) and pumped volume (m3) in each of the last slots of ``elapsed``; the last
            entry is the current slot.
        starts: times of the pump's last starts (s, as in ``elapsed``); the file contains the last
            hundred.
        on: whether the pump was on when the state was saved.
        boot: identifier of the computer's boot after which the state was saved; empty if unknown.
        boot_s: time from that boot until the state was saved (s).
        hold_since: time of the request for the hold (s since 1970); None if unknown.
    """

    hold_owner: str = ""
    hold_reason: str = ""
    hold_until: float | None = None
    unknown: str = ""
    fault: str = ""
    fault_code: str = ""
    elapsed: float = 0.0
    use: tuple[tuple[float, float], ...] = ()
    starts: tuple[float, ...] = ()
    on: bool = False
    boot: str = ""
    boot_s: float = 0.0
    hold_since: float | None = None

    @property
    def day_run(self) -> float:
        """Time for which the pump was on in the last 24 h (s)."""
        return math.fsum(run for run, _ in self.use)

    @property
    def day_volume(self) -> float:
        """Volume that was pumped in the last 24 h (m3)."""
        return math.fsum(volume for _, volume in self.use)

    def clears_in(self, *, run: float = math.inf, volume: float = math.inf) -> float:
        """Return the time (s) until the usage in 24 h is below both limits (s, m3)."""
        left = self
        while left.day_run >= run or left.day_volume >= volume:
            left = replace(left, use=left.use[1:])
        last_out = self.elapsed // _SLOT_S - len(left.use)  # the last slot that must drop out
        return max(0.0, (last_out + _SLOTS) * _SLOT_S - self.elapsed) if left != self else 0.0


class StateFile:
    """A pump's state, kept in a file if a file is specified.

    A missing file is created. The first user of a file owns it until it is closed or its process
    ends. Another user has an empty state, and writes nothing, until it can :meth:`acquire` the
    file.

    Attributes:
        file: the file; None if the state is kept in memory only.
        state: the current state.
    """

    def __init__(
        self, file: Path | None, zone: tzinfo = timezone.utc,
        system_clock: Callable[[], float] = time.time,
    ) -> None:
        """Read the file.

        Args:
            file: the file; None to keep the state in memory only.
            zone: time zone in which the times of a hold are shown.
            system_clock: function that returns the time (s since 1970).
        """
        # The current state, the latest one to write, and the last one that was written.
        self.state = self._latest = self._written = StoredState()
        self.file, self._zone, self._clock = file, zone, system_clock
        self._lock: socket | None = None
        # The number of the last line, and what the file must contain; empty if it must be created.
        self._number, self._content = 0, b""
        self._problem, self._saved = "", False
        self.changed_at = -math.inf
        self._unsaved_s = self._unseen_s = 0.0
        self.acquire()

    def acquire(self) -> bool:
        """Acquire and read the file unless that has been done; return whether this call did so.

        A hold and a fault that were requested before are kept.
        """
        if self.file is None or self._lock is not None:
            return False
        try:
            self._lock = acquire_name_lock(os.path.realpath(self.file))
        except (LockedError, OSError) as error:
            self._problem = self._explain(error)
            return False
        requested, self._problem = self.state, ""
        self._load(self.file)
        if requested.hold_owner:
            self.hold(requested.hold_owner, requested.hold_reason, requested.hold_until)
        if requested.fault:
            self.fault(requested.fault, requested.fault_code)
        return True

    # --- hold and fault ---------------------------------------------------------------------------

    @property
    def active_hold(self) -> Diagnosis | None:
        """Owner, start, end and reason of the hold as a diagnosis; None if there is no hold."""
        state, ends = self.state, self.state.hold_until
        if not state.hold_owner or (ends is not None and self._clock() >= ends):
            return None
        known = {"owner": state.hold_owner}
        for name, at in ("since", state.hold_since), ("until", ends):
            if at is not None:
                known[name] = to_people(datetime.fromtimestamp(at, self._zone))
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
        self._change(
            hold_owner=owner[:_MAX_TEXT], hold_reason=reason[:_MAX_TEXT],
            hold_since=self._clock(), hold_until=last,
        )
        return last == until

    def release(self) -> None:
        """End the hold, regardless of its owner."""
        self._change(hold_owner="", hold_reason="", hold_since=None, hold_until=None)

    def clear_unknown(self) -> None:
        """Clear the unknown state, accepting that an earlier hold or fault may have been lost."""
        self._change(unknown="")

    @property
    def unsaved(self) -> str:
        """Reason why the state has not been saved since the start; empty once it has been saved."""
        return "" if self._saved else self.problem or "the state is not saved yet"

    def save(self) -> None:
        """Queue the state for writing, after any write in progress; :meth:`check` tries again."""
        self._unsaved_s = 0.0
        if self._lock is not None:
            self._latest = replace(self.state, boot=boot_id(), boot_s=boot_time())
            DISK.do(self._update)

    def fault(self, text: str, code: str) -> None:
        """Latch a fault with its interlock's code; an empty text clears it."""
        self._change(fault=text, fault_code=code)

    def _change(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)
        self.save()

    # --- starts and usage -------------------------------------------------------------------------

    def switch(self, on: bool) -> None:
        """Record that the pump was started or stopped."""
        starts = (*self.state.starts, self.state.elapsed) if on else self.state.starts
        self._change(on=on, starts=starts[-_MAX_STARTS:])

    def count(self, dt: float, run: float, volume: float) -> None:
        """Add elapsed time (s), the pump's time on within it (s), and the pumped volume (m3)."""
        self._advance(dt)
        *earlier, (before_run, before_volume) = self.state.use or ((0.0, 0.0),)
        present = before_run + run, before_volume + volume
        self.state = replace(self.state, use=(*earlier, present))
        if run or volume:  # otherwise nothing needs to be written
            self._unsaved_s += dt
        if self._unsaved_s >= SAVE_EVERY_S:
            self.save()

    def count_unseen(self, max_run: float, flow: float) -> None:
        """Add the worst-case usage after a node that ended before it had confirmed the pump off.

        Args:
            max_run: longest time for which the pump may have run since the state was saved (s).
            flow: maximum flow (m3/s).
        """
        if self.state.on:
            run = min(self._unseen_s, max_run, DAY_S)
            self.count(0.0, run, run * flow)
            self.switch(False)

    def _advance(self, elapsed: float) -> None:
        before, now = self.state.elapsed, self.state.elapsed + elapsed
        new = min(int(now // _SLOT_S - before // _SLOT_S), _SLOTS)
        use = (*self.state.use, *[(0.0, 0.0)] * new)[-_SLOTS:]
        self.state = replace(self.state, elapsed=now, use=use)

    # --- writing ----------------------------------------------------------------------------------

    @property
    def problem(self) -> str:
        """Reason why the file could not be written; empty if it was written.

        Control continues regardless.
        """
        if self._lock is not None and DISK.late:
            return f"{self.file} could not be written within {PATIENCE_S:g} s"
        return self._problem

    def check(self) -> None:
        """Write the file again if another program has changed it, or if it could not be written."""
        if self._lock is not None:
            DISK.do(self._update)

    def flush(self, within: float = _WAIT_S) -> str:
        """Write the state, and return the reason if it is not on the disk, or else an empty text.

        Args:
            within: maximum time to wait for the disk (s); the write continues after that.
        """
        self.save()
        DISK.wait(within)
        if self._written is self._latest:
            return self.problem
        return self.problem or f"{self.file} is not yet on the disk; writing continues"

    def close(self) -> str:
        """Write the state and release the file; return the reason if it is not on the disk."""
        problem = self.flush(PATIENCE_S)
        if self._lock is not None and DISK.wait(0.0):
            self._lock.close()
            self._lock = None
        return problem

    def _update(self) -> None:
        """Write the latest state unless the file contains it; runs in the disk thread."""
        assert self.file is not None
        state = self._latest
        try:
            intact = _read(self.file) == self._content
        except OSError:
            intact = False
        if self._content and not intact:
            self.changed_at = boot_time()
        if intact and state is self._written:
            return
        try:
            self._write(self.file, state, lines=1 if intact else 2)
            self._written, self._problem, self._saved = state, "", True
        except Exception as error:  # whatever it is, the next state is still tried
            self._problem = self._explain(error)

    def _write(self, file: Path, state: StoredState, lines: int) -> None:
        """Write the state into the next line in place, or into both lines of a new file.

        Raises:
            OSError: if the disk is full or fails.
        """
        content, last = bytearray(self._content.ljust(2 * _LINE)), self._number + lines
        for number in range(self._number + 1, last + 1):
            start = _LINE * ((number + 1) % 2)
            content[start : start + _LINE] = line = _format(number, state)
        if lines == 1:
            _overwrite(file, start, line)
        elif os.path.lexists(file) and not file.is_file():  # such as a link to a missing disk
            raise FileExistsError(errno.EEXIST, "it exists but is not a file")
        else:
            replace_file(file, lambda stream: stream.write(content), parents=True)
            directory = os.open(file.parent, os.O_RDONLY)
            os.fsync(directory)
            os.close(directory)
        _overwrite(_number_file(file), 0, b"%-24d\n" % last)
        self._number, self._content = last, bytes(content)

    def _explain(self, error: Exception) -> str:
        why = getattr(error, "strerror", None) or str(error)
        return (
            f"{self.file} cannot be written: {why}; after a restart, holds, faults and the pumped "
            "volume would be unknown"
        )

    # --- reading ----------------------------------------------------------------------------------

    def _load(self, file: Path) -> None:
        """Read the file, and add the time since it was written."""
        content, lines, problems = b"", dict[int, StoredState](), list[str]()
        try:
            content = _read(file)
            for number in (1, 2):
                try:
                    lines |= _parse(content[_LINE * (number - 1) : _LINE * number])
                except Exception as error:  # whatever it is, the line may have contained a hold
                    problems.append(f"line {number}: {error}")
        except FileNotFoundError:
            problems = _find_traces(file)
        except OSError as error:
            problems = [str(error.strerror)]
        noted = _read_number(file)
        # The next line that is written replaces the broken one.
        self._number = max(lines, default=noted or secrets.randbelow(2**44))
        state = lines.get(self._number, StoredState())
        if noted and not problems and not noted <= self._number <= noted + _UNNOTED:
            problems, self._number = ["it is an older copy, or belongs to another site"], noted
        if problems and not state.unknown:
            state = replace(state, unknown=(
                f"{file} cannot be read ({'; '.join(problems)}), so it is unknown whether there "
                "was a hold or a fault; check the pump, then reset the fault"
            ))
        self.state = self._latest = self._written = state
        same_boot = "" != state.boot == boot_id()
        down = boot_time() - state.boot_s
        self._unseen_s = down if same_boot else math.inf
        if same_boot:
            self._advance(down)
        if problems or not content:
            self.save()
        else:
            self._content = content


def create_state_file(file: Path) -> None:
    """Create the file if it is missing, before other files would indicate that there was one.

    An existing file is left unchanged, since the age of its last line counts as unobserved usage.
    """
    if not os.path.lexists(file):
        StateFile(file).close()


def _number_file(file: Path) -> Path:
    return file.with_name(f"{file.name}.number")


def _read_number(file: Path) -> int:
    """Return the number of the last line that was written; 0 if it is unknown."""
    try:
        return int(_number_file(file).read_text())
    except (OSError, ValueError):
        return 0


def _find_traces(file: Path) -> list[str]:
    """Return evidence that a missing file used to exist; an empty disk for the bag is none."""
    paths = file, _number_file(file), *map(file.with_name, _OF_SITE)
    return [
        f"it is missing, although {path.name} exists" for path in paths if os.path.lexists(path)
        and not (path.is_dir() and all(each.name == "lost+found" for each in path.glob("*")))
    ]


def _read(file: Path) -> bytes:
    """Return the content of the file.

    Raises:
        OSError: if the file cannot be read, or has another length.
    """
    if not stat.S_ISREG(file.stat().st_mode):  # reading a pipe would block
        raise OSError(errno.EINVAL, "it is not a file")
    with file.open("rb") as stream:
        content = stream.read(2 * _LINE + 1)
    if len(content) != 2 * _LINE:
        raise OSError(errno.EINVAL, f"it must be {2 * _LINE} bytes long")
    return content


def _overwrite(file: Path, start: int, content: bytes) -> None:
    """Write bytes at a place in a file, which is created if it is missing.

    They are written by one call, which is not interrupted by a kill.

    Raises:
        OSError: if the disk is full or fails.
    """
    descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if os.pwrite(descriptor, content, start) < len(content):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _parse(line: bytes) -> dict[int, StoredState]:
    """Return the state in a line, by its number.

    Raises:
        Exception: of any type, if the line is damaged or has another format.
    """
    checksum, _, text = line.rstrip().partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        raise ValueError("its checksum is wrong")
    content = json.loads(text)
    if content["version"] != _VERSION:
        raise ValueError(f"its format is {content['version']}, but this version reads {_VERSION}")
    content.setdefault("hold_since", None)  # later than the other keys
    content["use"] = tuple((run, volume) for run, volume in content["use"])
    content["starts"] = tuple(content["starts"])
    state = StoredState(**{name: content[name] for name in asdict(StoredState())})
    times = [at for at in (state.hold_since, state.hold_until) if at is not None]
    for number in (*times, state.elapsed, state.boot_s, *state.starts, *chain(*state.use)):
        _NUMBER.check(number)
    if not all(isinstance(content[name], str) for name in _TEXTS):
        raise ValueError(f"{', '.join(_TEXTS)} must be text")
    return {content["sequence"]: state}


def _format(number: int, state: StoredState) -> bytes:
    """Return a line; texts are cut and numbers are rounded, so that any state fits."""
    content = {"version": _VERSION, "sequence": number, **asdict(state)}
    content["use"] = [[float(f"{value:.6g}") for value in slot] for slot in state.use]
    content["starts"] = [round(start, 1) for start in state.starts[-_SAVED_STARTS:]]
    while True:
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
        line = text.encode(errors="replace")
        if len(line) < _LINE - 10:
            return (b"%08x %b" % (zlib.crc32(line), line)).ljust(_LINE - 1) + b"\n"
        longest = max(_TEXTS, key=lambda name: len(content[name]))
        content[longest] = content[longest][:-10]
