"""A case of a rig with a drive: the fault, the time until the pump stands, and the recovery."""

from __future__ import annotations

import random
import subprocess
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

from faults.bounds import RAMP_S
from faults.cases import VALVE_ALARM, VALVE_MOVES, Case, Sign
from faults.inject import begin
from faults.rig import BrokenError, Rig, SiteRig, leftover, wait
from mcap.exceptions import McapError
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from greenroof_ros.live.recorder import FLUSH_S, RETRY_S
from greenroof_ros.results.bag_write import find_files

# How long to wait beyond the bound, to see how much it is exceeded (s).
_LONGER_S = 10.0
# Time from a node's kill until the pump must run again: back-off, start, recovery (s).
_RECOVERY_S = 75.0
# Time from a start for which what has not come yet is only listed on the page, without advice (s).
_LISTED_S = 60.0
# Time within which bringup must end once the pump stands (s).
_END_S = 50.0
_MIN_SPEED = 0.05
_STEADY_S = 6.0
# Time after which no alarm of the fault may be shown any more (s); a gauge or a forecast file that
# is good again counts only after a while.
_CLEAR_S = 15.0
# Time in which a valve that opens again drains what shows this, by the level (s).
_DRAINS_S = 240.0
# How far below the suction level the cistern may be pumped: five seconds at full flow (m).
_DRY_M = 0.002
# What a recorder may lose (s): data since its last flush, and the flush in progress.
_LOST_S = FLUSH_S + 1.0


@dataclass
class Outcome:
    """The outcome of a case.

    Attributes:
        to_safe: time from the fault until the pump stands, or until the alarm if it cannot be
            stopped (s); None if it had to run on.
        bound: of that time (s).
        signs: what was shown of the cause: status and code.
        lost: seconds before the fault that a bag lacks; None if nothing could be lost.
        recovery: what happened afterwards.
        recovered: time until the pump ran again (s); None if it did not automatically.
        wrong: deviations from what must happen; empty if there are none.
    """

    to_safe: float | None = None
    bound: float | None = None
    signs: list[Sign] = field(default_factory=list)
    lost: float | None = None
    recovery: str = ""
    recovered: float | None = None
    wrong: str = ""

    def fail(self, what: str) -> None:
        self.wrong = "; ".join(filter(None, (self.wrong, what)))


def run_case(rig: Rig, case: Case, rng: random.Random, outcome: Outcome) -> None:
    """Do a case to a rig, and note the outcome.

    Args:
        rig: the rig.
        case: the case.
        rng: for everything that is random.
        outcome: where it is noted.

    Raises:
        BrokenError: the pump did not run before the case.
    """
    # The previous case may still have an effect: a level received just before its sensor died
    # becomes too old after its limit. A limit of the pump's use counts from its start.
    if case.expected.stops is not False and case.fault != "stuck for ever":
        rig.until_guarded()
    rig.until_running(steady_s=_STEADY_S if case.expected.stops is False else 0.0)
    rig.watchers[1:] = []
    if case.target == "station" and isinstance(rig, SiteRig):
        _until_it_records(rig.output / "bag", rng)
    time.sleep(rng.uniform(0.0, 1.0))  # a random phase of the ticks, which last a second
    if not rig.runs():
        rig.until_running()
    outcome.bound = rig.bounds()[case.expected.bound]
    _fault(rig, case, rng, outcome)
    if rig.truth.maximum > 1.001:
        outcome.fail(f"the pump turned at {rig.truth.maximum:.3f} of its rated speed")
    if isinstance(rig, SiteRig) and rig.levels()[0] < rig.site.suction_level - _DRY_M:
        outcome.fail("the pump ran dry")


def _until_it_records(bag: Path, rng: random.Random) -> None:
    """Wait until a recorder that an earlier case ended writes again, then for a random time."""

    def written() -> tuple[Path | None, int]:
        file = newest_file(bag)
        return file, 0 if file is None else file.stat().st_size

    before = written()
    wait(lambda: written() != before, 60, "a recorder that writes")
    time.sleep(rng.uniform(0.0, FLUSH_S))


def newest_file(bag: Path) -> Path | None:
    """Return the file of a live bag that is being written."""
    return (find_files(bag) or [None])[-1]


def last_message(file: Path) -> float:
    """Return the time of the last whole message in a file, closed or not (s since 1970)."""
    last = 0
    with suppress(McapError, EOFError), file.open("rb") as stream:  # it may be cut
        for record in StreamReader(stream, emit_chunks=True).records:
            records = breakup_chunk(record) if isinstance(record, Chunk) else [record]
            last = max([last, *(part.log_time for part in records if isinstance(part, Message))])
    return last / 1e9


def _fault(rig: Rig, case: Case, rng: random.Random, outcome: Outcome) -> None:
    expected = case.expected
    began, alarms = time.monotonic(), rig.alarms()
    recorded = newest_file(rig.output / "bag") if isinstance(rig, SiteRig) else None
    clock, printed = time.time(), len(rig.main.stderr())
    with ExitStack() as undo:
        begin(rig, case, rng, undo)
        slow = ("dry", "power cycle, then kill", "unstoppable", "timeout rewritten",
                "failing disk", VALVE_ALARM, VALVE_MOVES)
        if case.fault in slow or case.fault.startswith("second"):
            began = time.monotonic()  # the fault took some time to begin
        if expected.stops:
            _until_at_rest(rig, case, began, outcome)
        else:
            time.sleep(max(0.0, began + expected.watch - time.monotonic()))
        since = 0.0 if case.fault == "from the start" else began
        _signs(rig, case, since, alarms, outcome)
        if case.fault in ("unstoppable", VALVE_ALARM):
            outcome.to_safe = time.monotonic() - began
        if expected.stops is False and rig.truth.minimum(began, time.monotonic()) < _MIN_SPEED:
            outcome.fail(f"the pump stopped, but should have run on: {_reported(rig, began)}")
        if shown := rig.signs(began, alarms).intersection(expected.never):
            outcome.fail(f"shown without a reason: {shown}")
        if expected.recovery == "ends":  # the fault stays until then
            _ends(rig, case, outcome)
        elif expected.names not in rig.main.stderr()[printed:]:
            outcome.fail(f"bringup did not print {expected.names}")
    if expected.recovery != "ends":
        _recover(rig, case, outcome)
    outcome.signs = sorted(rig.signs(began, alarms))
    if recorded and case.target == "station" and case.fault in ("kill", "term", "stop long"):
        outcome.lost = max(0.0, clock - (last_message(recorded) or recorded.stat().st_mtime))
        if outcome.lost > _LOST_S:
            outcome.fail(f"{outcome.lost:.1f} s before the fault are not in the bag")


def _until_at_rest(rig: Rig, case: Case, began: float, outcome: Outcome) -> None:
    assert outcome.bound is not None
    until = began + outcome.bound + _LONGER_S
    stopped_after = None
    while stopped_after is None and time.monotonic() < until:
        time.sleep(0.02)
        stopped_after = rig.truth.stopped_at(began)
    if stopped_after is None:
        outcome.fail(
            f"the pump had not stopped {until - began:.1f} s after the fault (bound "
            f"{outcome.bound:.1f} s), at {rig.truth.speed:.2f} of its speed; "
            f"{_reported(rig, began)}"
        )
        return
    outcome.to_safe = stopped_after - began
    if outcome.to_safe > outcome.bound:
        outcome.fail(
            f"the pump stopped after {outcome.to_safe:.2f} s, bound {outcome.bound:.2f} s; "
            f"{_reported(rig, began)}"
        )


def _signs(
    rig: Rig, case: Case, began: float, alarms: int, outcome: Outcome
) -> None:
    """Check that all signs of a fault are shown."""
    assert outcome.bound is not None
    until = max(began + outcome.bound, time.monotonic() + 2.0)
    if case.expected.recovery == "ends":
        until += _END_S  # a node that waits in vain ends later than the pump stands
    elif case.fault == "from the start" or case.target.startswith("in another domain"):
        until += _LISTED_S
    elif case.fault in ("state file", "failing disk"):
        until += _RECOVERY_S  # the node reads it when it is started again
    while missing := set(case.expected.signs) - rig.signs(began, alarms):
        if time.monotonic() > until:
            outcome.fail(
                f"not shown: {missing}, but {sorted(rig.signs(began, alarms))}; messages: "
                f"{_reported(rig, began)}, {rig.main.stderr()[-400:]!r}"
            )
            return
        time.sleep(0.05)


def _reported(rig: Rig, began: float) -> list[str]:
    """Return what was reported since a time, each with the delay (s)."""
    reports = [(at - began, who, text) for at, who, text in rig.watcher.texts if at >= began]
    return [f"{after:.2f} {who} {text}" for after, who, text in reports[:30]]


def _recover(rig: Rig, case: Case, outcome: Outcome) -> None:
    """Check that the rig recovers as specified."""
    expected = case.expected.recovery
    if expected == "stays":
        since = time.monotonic()
        time.sleep(5.0)
        if rig.truth.max_speed(since, time.monotonic()) > _MIN_SPEED:
            outcome.fail("the pump ran again")
        outcome.recovery = "stayed off"
        return
    began = time.monotonic()
    patience = _RECOVERY_S if expected == "heals" else 12.0
    while time.monotonic() < began + patience:
        if rig.runs():
            outcome.recovery, outcome.recovered = "ran again", time.monotonic() - began
            _check_no_alarm(rig, case, outcome)
            if expected == "latches":
                outcome.fail("the fault did not latch: the pump ran again automatically")
            return
        if rig.watcher.state == "fault" and expected != "heals":
            time.sleep(RAMP_S + 1.0)  # the fault may have latched while the pump turned
            break
        time.sleep(0.05)
    if expected == "heals":
        outcome.fail(f"did not heal within {patience:.0f} s: {rig.watcher.last.get('pump: pump')}")
    if rig.watcher.state != "fault" and expected == "latches":
        outcome.fail(f"no latched fault: {rig.watcher.last.get('pump: pump')}")
    max_speed = rig.truth.max_speed(time.monotonic() - 0.5, time.monotonic())
    if max_speed > _MIN_SPEED:
        outcome.fail(f"the pump turns at {max_speed:.2f} while its fault is latched")
    answer = rig.watcher.reset()
    try:
        rig.until_running(30)
        outcome.recovery = "ran again after ~/reset"
    except BrokenError as error:
        outcome.fail(f"did not run after ~/reset ({answer}): {error}")


def _check_no_alarm(rig: Rig, case: Case, outcome: Outcome) -> None:
    """Check that no alarm of the fault remains."""
    until = time.monotonic() + _CLEAR_S
    if case.fault == "full disk":
        until += RETRY_S + FLUSH_S  # the recorder's wait before it tries again
    if case.target == "stuck closed":
        until += _DRAINS_S
    while standing := set(rig.watcher.codes.items()).intersection(case.expected.signs):
        if time.monotonic() > until:
            outcome.fail(f"still an alarm after the end of the fault: {standing}")
            return
        time.sleep(0.05)


def _ends(rig: Rig, case: Case, outcome: Outcome) -> None:
    """Check that bringup ends with a reason, and all its processes with it."""
    pids = set(rig.pids().values()) | rig.started
    try:
        code = rig.main.process.wait(_END_S)
    except subprocess.TimeoutExpired:
        outcome.fail(f"bringup did not end within {_END_S:.0f} s")
        return
    expected = {"kill": -9, "term": 0}.get(case.fault, -9)
    if code != expected:
        outcome.fail(f"bringup ended with exit code {code}, not {expected}")
    if still := leftover(pids):
        outcome.fail(f"{len(still)} processes were left after 12 s")
    outcome.recovery = "ended"
