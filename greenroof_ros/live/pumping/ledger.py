"""The state of the pump node that must survive a restart: hold, fault, starts, and usage in 24 h.

A hold keeps the pump off. The owner of a hold is whoever requested it; its reason may be empty, and
it may have no end. The ledger promises:

- The hold is read before the pump may run. It survives restarts and power cuts.
- There is one hold at a time. A later request replaces its owner and reason, but never shortens it:
  the later end applies, and a hold without an end counts as the latest.
- A hold ends at the specified time on the system clock, or when anyone releases it.
- If it is unknown whether there was a hold or a fault, the pump stays off until someone who has
  checked the pump clears this state.

The file has two lines of fixed length, which are padded with blanks and alternately overwritten in
place. Its space is allocated when the file is created, so a hold or a fault can be saved even if
the disk later becomes full (except on file systems that never write in place: btrfs, zfs). Each
line begins with its checksum and is one page long. Killing the process does not tear a page, but a
power cut may. The other line is then intact, but the torn line may have contained a hold or a
fault, so it is unknown whether there was one. Holds and faults are also unknown if the file cannot
be read, has a later format, is an older copy or that of another site, or is missing while another
file shows that there was a pump node before. Unknown keys are ignored, and some keys may be
missing. The file is created under another name, then renamed.

The disk thread writes the file, so a slow disk does not delay the control of the pump. A lock on a
file next to it ensures that only one ledger writes, since the record of a second ledger would erase
a hold or a fault. The lock file also contains the number of the last line that was written. The
first number is random, so the numbers differ between sites. If another program removes or changes
the file, it is written again.

Usage is counted in half-hour slots over the last 24 h of the ledger's clock, which starts at
the ledger's first step and follows the computer's steady clock, whether or not the node is running.
Time before the computer's start is not added, since it is unknown whether the system clock was
correct then. The oldest slot counts in full until all of it is more than 24 h old.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import secrets
import stat
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

from greenroof_ros.base.disk import DISK, PATIENCE_S
from greenroof_ros.base.processes import LockedError
from greenroof_ros.base.ranges import Range
from greenroof_ros.base.times import to_people
from greenroof_ros.interface.alarm import ALARMS
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.boot_clock import boot_id, boot_time
from greenroof_ros.live.latest_writer import LatestWriter

DAY_S = 86_400.0
RECORD = "pump.json"
"""the file's name in the directory of a live site"""
# Length of a slot (s), and the number of slots that the last 24 h touch.
_SLOT_S, _SLOTS = 1800.0, 49
MAX_NUMBER = 1e11
"""No number in the record is larger; as a time, it is in the year 5138."""
# Length of a line (bytes): a page, and a block of most disks.
_LINE = 4096
# Maximum bytes of a text and of an owner in JSON, and maximum number of starts: all fit in a line.
_TEXT, _OWNER, _STARTS = 350, 40, 100
# The format of the file. In a later one, a key has another meaning; new keys alone do not change
# it.
_VERSION = 1
# Files next to the record: the one being made, and a broken one that another version moved away.
_NEW, _LOCK, _LEFTOVERS = ".new", ".lock", (".new", ".broken")
# Length of the holder's process ID at the beginning of the lock file (bytes).
_HOLDER_BYTES = 32
# What a live site writes next to the record.
_OF_SITE = ("summary.json", ALARMS, "bag", "configuration")
# How many lines may have been written after the last number that is on the disk, since that number
# is not forced onto it; and the range of the first numbers.
_UNNOTED, _FIRST = 10_000, 2**44
# How many starts to remember: no pump may start more often in the hour that counts.
_MAX_STARTS = 3600
# While the pump is on, at most this much of its time on is not yet on the disk (s).
SAVE_EVERY_S = 10.0
# A service waits this long for the disk (s), well below the silence after which a node is killed.
_WAIT_S = 0.5


@dataclass(frozen=True)
class PumpRecord:
    """State of the pump that is preserved across restarts.

    Attributes:
        hold_owner: owner of the hold; empty if there is no hold.
        hold_reason: reason for the hold; may be empty.
        hold_until: end of the hold on the system clock (s since 1970); None if it has no end.
        unknown: reason why it is unknown whether there was a hold or a fault; empty if this is
            known.
        fault: the latched fault; empty if there is none.
        fault_code: code of the fault's interlock.
        elapsed: time since the ledger's first step (s).
        use: time on (s) and pumped volume (m3) in each of the last slots of ``elapsed``; the last
            entry is the current slot.
        starts: times of the pump's last starts (s, as in ``elapsed``); the file contains the last
            hundred.
        on: whether the pump was on when the record was written.
        boot: identifier of the computer's boot after which the record was written; empty if
            unknown.
        boot_s: time from that boot until the record was written (s).
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

    @property
    def hold(self) -> tuple[str, str, float | None]:
        """Owner, reason and end of the hold."""
        return self.hold_owner, self.hold_reason, self.hold_until

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


class Ledger:
    """The pump's record, kept in a file if a file is specified.

    If the file is missing, the record is empty and the file is created immediately. The first
    ledger of a file owns it until the ledger is closed or its process ends. A second ledger reads
    the file at its own start, and writes nothing until it can acquire the file (:meth:`acquire`).

    Attributes:
        record: the current record.
    """

    def __init__(self, file: Path | None, system_clock: Callable[[], float]) -> None:
        """Read the file.

        Args:
            file: file of the record; None to keep the record in memory only.
            system_clock: function that returns the time (s since 1970), such as :func:`time.time`.
        """
        self._file = file
        self._clock = system_clock
        self._unsaved = 0.0
        self._unseen = 0.0
        self._file_lock: FileIO | None = None  # the lock
        self.record = self._at_start = PumpRecord()
        if file is not None:
            self._lines = _Lines(file)
            self._writer = LatestWriter(self._lines.write, partial(_error_text, file))
            noted = _read_number(file)
            self._lock(file)
            self._load(file, noted)

    def acquire(self) -> bool:
        """Acquire the file unless it is already acquired; return whether this call acquired it.

        The file's current content counts, plus any hold and fault that this ledger received in the
        meantime. An earlier release does not apply to the file's content, even if that content is
        unreadable.
        """
        if self._file is None or self._file_lock is not None:
            return False
        noted = _read_number(self._file)
        if not self._lock(self._file):
            return False
        mine, before = self.record, self._at_start
        self._load(self._file, noted)
        if mine.hold_owner and mine.hold != before.hold:
            self.hold(*mine.hold)
        if mine.fault and mine.fault != before.fault:
            self.fault(mine.fault, mine.fault_code)
        return True

    def _lock(self, file: Path) -> bool:
        """Become the only writer of the file, and return True on success."""
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._file_lock = _acquire_lock(_lock_file(file))
            self._lines.lock = self._file_lock
        except (LockedError, OSError, ValueError) as error:
            self._writer.problem = _error_text(file, error)
            return False
        self._writer.problem = ""
        return True

    def _load(self, file: Path, noted: int | None) -> None:
        """Load the content of the file, and add the time since it was written; see `_read`."""
        self.record, self._lines.sequence, intact = _read(file, noted)
        self._at_start = self.record
        same_boot = "" != self.record.boot == boot_id()
        down = boot_time() - self.record.boot_s
        if self.record.on:
            self._unseen = down if same_boot else math.inf
        if same_boot:
            self._advance(down)
        if not intact:
            self._save()

    @property
    def problem(self) -> str:
        """Reason why the file could not be written; empty if it was written.

        Control continues regardless.
        """
        if self._file is None:
            return ""
        if self._file_lock is not None and DISK.late:
            return f"{self._file} could not be written within {PATIENCE_S:g} s"
        return self._writer.problem

    @property
    def now(self) -> float:
        """The system time (s since 1970)."""
        return self._clock()

    @property
    def active_hold(self) -> Diagnosis | None:
        """Owner, end and reason of the hold as a diagnosis; None if there is no hold."""
        owner, reason, until = self.record.hold
        if not owner or (until is not None and self.now >= until):
            return None
        end = {} if until is None else {
            "until": to_people(datetime.fromtimestamp(until).astimezone())
        }
        more = end | ({"reason": reason} if reason else {})
        return Diagnosis.of("hold", "owner", *more, owner=owner, **more)

    def hold(self, owner: str, reason: str = "", until: float | None = None) -> None:
        """Keep the pump off until a release, or until a time (s since 1970) if one is specified."""
        if self.active_hold:
            ends = until, self.record.hold_until
            until = None if None in ends else max(end for end in ends if end is not None)
        self.record = replace(
            self.record, hold_owner=owner, hold_reason=reason, hold_until=until
        )
        self._save()

    def release(self) -> None:
        """End the hold, regardless of its owner."""
        self.record = replace(self.record, hold_owner="", hold_reason="", hold_until=None)
        self._save()

    def clear_unknown(self) -> None:
        """Clear the unknown state, accepting that an earlier hold or fault may have been lost."""
        self.record = replace(self.record, unknown="")
        self._save()

    def fault(self, text: str, code: str) -> None:
        """Latch a fault with its interlock's code; an empty text clears it."""
        self.record = replace(self.record, fault=text, fault_code=code)
        self._save()

    def switch(self, on: bool) -> None:
        """Record that the pump was started or stopped."""
        record = self.record
        if on:
            record = replace(record, starts=(*record.starts, record.elapsed)[-_MAX_STARTS:])
        self.record = replace(record, on=on)
        self._save()

    def count(self, dt: float, run: float, volume: float) -> None:
        """Add elapsed time (s), the pump's time on within it (s), and the pumped volume (m3)."""
        self._advance(dt)
        *earlier, (before_run, before_volume) = self.record.use or ((0.0, 0.0),)
        present = before_run + run, before_volume + volume
        self.record = replace(self.record, use=(*earlier, present))
        # Without use, nothing needs to be written unless the file could not be written before.
        if run or volume or self.problem:
            self._unsaved += dt
        if self._unsaved >= SAVE_EVERY_S:
            self._save()

    def count_unseen(self, max_run: float, flow: float) -> None:
        """Add the worst-case usage after a node that ended before it had confirmed the pump off.

        Args:
            max_run: longest time for which the pump may have run since the record was written (s).
            flow: maximum flow (m3/s).
        """
        if self.record.on:
            run = min(self._unseen, max_run, DAY_S)
            self.count(0.0, run, run * flow)
            self.switch(False)

    def check_file(self) -> bool:
        """Rewrite the file if another program has changed it; return whether that ever happened."""
        if self._file_lock is None:
            return False
        if self._lines.changed:
            self._save()
        DISK.do(self._lines.check)
        return self._lines.changed

    def flush(self, within: float = _WAIT_S) -> str:
        """Write the record, and return the reason if it is not on the disk, or else an empty text.

        Args:
            within: maximum time to wait for the disk (s); the write continues after that.
        """
        self._save()
        if not DISK.wait(within):
            return self.problem or f"{self._file} is not yet on the disk; writing continues"
        return self.problem

    def close(self) -> str:
        """Write the record and release the file; return the reason if it is not on the disk."""
        problem = self.flush(PATIENCE_S)
        if self._file is not None and self._file_lock is not None and DISK.wait(0.0):
            if not self._lines.sequence:  # never made, so the next start counts as a first one, too
                _lock_file(self._file).unlink(missing_ok=True)
            self._file_lock.close()
            self._file_lock = None
        return problem

    def _advance(self, elapsed: float) -> None:
        before, now = self.record.elapsed, self.record.elapsed + elapsed
        new = min(int(now // _SLOT_S - before // _SLOT_S), _SLOTS)
        use = (*self.record.use, *[(0.0, 0.0)] * new)[-_SLOTS:]
        self.record = replace(self.record, elapsed=now, use=use)

    def _save(self) -> None:
        """Queue the record for writing, after any write in progress."""
        self._unsaved = 0.0
        if self._file_lock is not None:
            self._writer.write(replace(self.record, boot=boot_id(), boot_s=boot_time()))


def make_record(file: Path) -> None:
    """Create the file if it is missing, before other files would indicate that a pump node has run.

    An existing file is left unchanged, since the age of its last line counts as unobserved usage.
    """
    if not os.path.lexists(file):
        Ledger(file, time.time).close()


class _Lines:
    """The two lines of the file.

    Attributes:
        sequence: number of the latest line; 0 if the file must be created.
        changed: whether another program was found to have changed the file.
        lock: the lock file, in which the number is also written; None before the file is locked.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self.sequence = 0
        self.changed = False
        self.lock: FileIO | None = None
        self._written = b""  # the newest line

    def check(self) -> None:
        """Check whether the latest line is unchanged; runs on the disk thread."""
        if self._written:
            self.changed = not self._is_written()

    def _is_written(self) -> bool:
        try:
            # Not a pipe, since reading one would block.
            content = self._file.read_bytes() if self._file.is_file() else b""
        except OSError:
            return False
        start = _LINE * ((self.sequence + 1) % 2)
        return len(content) == 2 * _LINE and content[start : start + _LINE] == self._written

    def write(self, record: PumpRecord) -> None:
        """Write a record; runs on the disk thread."""
        if self.sequence and (self._is_written() if self._written else self._file.exists()):
            _overwrite(self._file, self.sequence + 1, record)
            self.sequence += 1
        else:
            first = (self.sequence or secrets.randbelow(_FIRST)) // 2 * 2 + 3
            _create(self._file, first, record)
            self.sequence = first + 1
        self._written = _line(self.sequence, record)
        if self.lock is not None:
            with suppress(OSError):
                os.pwrite(self.lock.fileno(), b"%-24d\n" % self.sequence, _HOLDER_BYTES)


def _error_text(file: Path, error: Exception) -> str:
    if isinstance(error, LockedError):
        return (
            f"{file} cannot be written: process {error.holder or 'unknown'} is already using it; "
            "end that process, and this process continues automatically; or give this process "
            "another file (--state, state_file)"
        )
    why = getattr(error, "strerror", None) or repr(error)
    return (
        f"{file} cannot be written: {why}; after a restart, holds, faults and the pumped volume "
        "would be unknown"
    )


def _line(sequence: int, record: PumpRecord) -> bytes:

    def short(text: str, max_bytes: int = _TEXT) -> str:
        printable = "".join(letter if letter.isprintable() else " " for letter in text[:max_bytes])
        while len(json.dumps(printable, ensure_ascii=False).encode()) > max_bytes + 2:  # its quotes
            printable = printable[:-1]
        return printable

    record = replace(
        record, hold_owner=short(record.hold_owner, _OWNER), hold_reason=short(record.hold_reason),
        unknown=short(record.unknown), fault=short(record.fault),
    )
    content = {"version": _VERSION, "sequence": sequence, **asdict(record)}
    content["use"] = [tuple(map(_rounded_up, slot)) for slot in record.use]
    content["starts"] = [round(start, 1) for start in record.starts[-_STARTS:]]
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":")).encode()
    line = b"%08x " % zlib.crc32(text) + text
    assert len(line) < _LINE
    return line.ljust(_LINE - 1) + b"\n"


def _rounded_up(value: float) -> float:
    """Return the value rounded up to four digits, so that any usage fits on a line."""
    if value == 0:
        return 0
    unit = 10.0 ** (math.floor(math.log10(value)) - 3)
    return float(f"{math.ceil(value / unit * (1 - 1e-12)) * unit:.4g}")


def _create(file: Path, first: int, record: PumpRecord) -> None:
    """Write the file under another name, then rename it, which replaces a damaged file atomically.

    The remains of a failed attempt would keep the pump off at the next start, so they are removed
    unless a hold or a fault would then be forgotten.

    Raises:
        OSError: if the file cannot be written, for instance because the disk is full.
    """
    if os.path.lexists(file) and not file.is_file():
        raise FileExistsError(errno.EEXIST, "it exists but is not a file")
    file.parent.mkdir(parents=True, exist_ok=True)
    new_file = file.with_name(file.name + _NEW)
    try:
        with new_file.open("wb") as stream:
            stream.write(_line(first, record) + _line(first + 1, record))
            stream.flush()
            os.fsync(stream.fileno())
        new_file.replace(file)
    except OSError:
        if not (record.hold_owner or record.fault or record.unknown):
            with suppress(OSError):
                new_file.unlink()
        raise
    directory = os.open(file.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def _overwrite(file: Path, sequence: int, record: PumpRecord) -> None:
    """Overwrite the line whose turn it is.

    Raises:
        OSError: if the disk fails.
    """
    descriptor = os.open(file, os.O_WRONLY)
    try:
        os.pwrite(descriptor, _line(sequence, record), _LINE * ((sequence + 1) % 2))
        os.fdatasync(descriptor)
    finally:
        os.close(descriptor)


def _lock_file(file: Path) -> Path:
    """Return the lock file; the record's file cannot be locked, since it is replaced if damaged."""
    return file.with_name(file.name + _LOCK)


def _acquire_lock(path: Path) -> FileIO:
    """Open and lock a file, and return it; the lock is held until the file is closed.

    The file contains the process ID of the lock's holder, and then the number of the record's last
    line. Therefore it must not be truncated by a process that fails to lock it, as by filelock.

    Raises:
        LockedError: if another process holds the lock.
        OSError: if the file cannot be opened.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW
    lock = FileIO(os.open(path, flags, 0o600), "r+")
    try:
        fcntl.flock(lock.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        text = lock.read(_HOLDER_BYTES).decode("ascii", "replace").strip()
        lock.close()
        raise LockedError(path, int(text) if text.isdecimal() else None) from None
    with suppress(OSError):  # the disk is full: the lock holds all the same
        lock.write(f"{os.getpid()}\n".ljust(_HOLDER_BYTES).encode())
    return lock


def _read_number(file: Path) -> int | None:
    """Return the number of the last line that was written; 0 if unknown, None without a lock."""
    try:
        return int(_lock_file(file).read_bytes()[_HOLDER_BYTES:] or 0)
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        return 0


def _read(file: Path, noted: int | None) -> tuple[PumpRecord, int, bool]:
    """Read the file.

    Args:
        file: the file.
        noted: number of the last line that was written (0 if unknown); None if there was no lock.

    Returns:
        The latest record; its number, 0 if the file must be created; and whether the file was
        intact. If the file was not intact, the record keeps the pump off.
    """
    numbered, problems = [], []
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise ValueError("it is not a file")
        with file.open("rb") as stream:
            content = stream.read(2 * _LINE + 1)
        if len(content) != 2 * _LINE:
            raise ValueError(f"it must be {2 * _LINE} bytes long")
        for number in range(2):
            try:
                numbered.append(_parse(content[number * _LINE : (number + 1) * _LINE], number))
            except ValueError as error:
                problems.append(f"line {number + 1}: {error}")
    except FileNotFoundError:
        problems = _traces(file, noted)
        if not problems:
            return PumpRecord(), 0, False
    except (OSError, ValueError) as error:
        problems = [getattr(error, "strerror", None) or str(error)]
    # The broken line is written next, which repairs the file.
    sequence, record = max(numbered, key=lambda pair: pair[0], default=(0, PumpRecord()))
    if noted and numbered and not problems and not noted <= sequence <= noted + _UNNOTED:
        problems, sequence = ["it is an older copy, or belongs to another site"], noted
    if problems:
        unknown = (
            f"{file} cannot be read ({'; '.join(problems)}), so it is unknown whether there was "
            "a hold or a fault; check the pump, then reset the fault"
        )
        record = replace(record, unknown=record.unknown or unknown)
    return record, sequence, not problems


def _traces(file: Path, noted: int | None) -> list[str]:
    """Return evidence that a missing file used to exist; see `_read`."""
    if file.is_symlink():
        return [f"it is a link to {file.readlink()}, which does not exist"]
    names = *(file.name + ending for ending in _LEFTOVERS), *_OF_SITE
    left = [name for name in names if os.path.lexists(file.with_name(name))]
    if "bag" in left and _is_empty_disk(file.with_name("bag")):
        left.remove("bag")
    if noted is not None:
        left.append(_lock_file(file).name)
    return [f"it is missing, although {name} exists" for name in left]


def _is_empty_disk(path: Path) -> bool:
    """Return whether a path is a directory without files, such as a new disk mounted for bags."""
    try:
        return not path.is_symlink() and {each.name for each in path.iterdir()} <= {"lost+found"}
    except OSError:  # not a directory, or one that cannot be read
        return False


def _parse(line: bytes, number: int) -> tuple[int, PumpRecord]:
    """Return a line's sequence number and record.

    Raises:
        ValueError: if the line is damaged or has a later format.
    """
    checksum, _, text = line.rstrip().partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        raise ValueError("its checksum is wrong")
    try:
        content = json.loads(text)
    except RecursionError:
        content = None
    if not isinstance(content, dict):
        raise ValueError("it must be a table of keys")
    if content.get("version", _VERSION) != _VERSION:
        raise ValueError(f"its format is {content['version']}, but this version reads {_VERSION}")
    if "use" not in content:  # written by a version that counted fixed days
        content["use"] = [[content.get("day_run", 0.0), content.get("day_volume", 0.0)]]
    for name, (kind, is_right) in _KINDS.items():
        if name not in content and name in _REQUIRED:
            raise ValueError(f"it does not contain {name}")
        if name in content and not is_right(content[name]):
            raise ValueError(f"{name} must be {kind}")
    sequence = content.pop("sequence")
    if (sequence + 1) % 2 != number:
        raise ValueError("its sequence belongs to the other line")
    known = {name: value for name, value in content.items() if name in _KINDS}
    starts, use = tuple(known.get("starts", ())), tuple(map(tuple, known["use"]))
    return sequence, PumpRecord(**known | {"starts": starts, "use": use})


def _is_pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(each in _NUMBER for each in value)


# Without these keys it would be unknown whether the pump may run; the others have harmless
# defaults.
_REQUIRED = {"sequence", "hold_owner", "unknown", "fault", "elapsed", "on"}
_TEXT_KIND = "text", lambda value: isinstance(value, str)
_NUMBER = Range(0.0, MAX_NUMBER)
# What the value of each key must be, and the function that checks it.
_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "sequence": ("a whole number above 0", lambda value: type(value) is int and value > 0),
    "hold_until": ("a number or null", lambda value: value is None or value in _NUMBER),
    **dict.fromkeys(("hold_owner", "hold_reason", "unknown", "fault", "fault_code"), _TEXT_KIND),
    "boot": _TEXT_KIND,
    **dict.fromkeys(("elapsed", "boot_s"), (str(_NUMBER), _NUMBER.__contains__)),
    "use": (
        f"at most {_SLOTS} pairs of numbers", lambda value: isinstance(value, list)
        and len(value) <= _SLOTS and all(_is_pair(each) for each in value),
    ),
    "starts": (
        "a list of numbers",
        lambda value: isinstance(value, list) and all(each in _NUMBER for each in value),
    ),
    "on": ("true or false", lambda value: isinstance(value, bool)),
}
