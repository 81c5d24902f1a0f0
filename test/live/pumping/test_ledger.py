"""What survives a restart, a power cut, a full disk and a broken file."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pytest
from disks import small_disk
from graphs import wait_for
from hypothesis import given, settings
from hypothesis import strategies as st
from paper import PAPER_SITE
from pump_rig import Rig, settings_for

from greenroof_ros.base.files import state_directory
from greenroof_ros.base.times import to_people
from greenroof_ros.live.pumping import ledger as ledger_module
from greenroof_ros.live.pumping.ledger import Ledger, PumpRecord
from greenroof_ros.live.pumping.pump_control import PumpControl


class Clock:
    """Both clocks of a machine, set by hand."""

    now = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(ledger_module, "boot_time", clock)
    return clock


def written(file: Path) -> dict[str, Any]:
    """Return the newest line of a file as a person reads it, as soon as it is there."""

    def newest() -> dict[str, Any]:
        try:
            lines = file.read_text().splitlines()
            records = [json.loads(line.split(maxsplit=1)[1]) for line in lines]
        except (FileNotFoundError, ValueError):  # it is being written
            return {}
        return max(records, key=lambda line: int(line["sequence"]))

    return wait_for(newest, 60, "the file")  # type: ignore[no-any-return]


def read(file: Path, clock: Callable[[], float]) -> PumpRecord:
    """Return what a new ledger reads, and release the file."""
    return Ledger(file, clock).record


def test_a_missing_file_is_a_fresh_record_and_is_made(tmp_path: Path, clock: Clock) -> None:
    """With its directories and its final size; only the lock file is next to it."""
    file = tmp_path / "greenroof" / "state" / "pump.json"
    ledger = Ledger(file, clock)
    assert (ledger.record, ledger.flush(20.0)) == (PumpRecord(), "")
    assert file.stat().st_size == 8192
    assert {path.name for path in file.parent.iterdir()} == {"pump.json", "pump.json.lock"}


def test_a_second_ledger_erases_nothing(tmp_path: Path, clock: Clock) -> None:
    """It reports who has the file; when that ledger has gone, it takes over what was written.

    A hold that was requested meanwhile counts, but not a release.
    """
    file = tmp_path / "pump.json"
    first = Ledger(file, clock)
    first.switch(True)
    assert first.flush() == ""
    second, third = Ledger(file, clock), Ledger(file, clock)
    assert not second.acquire()
    second.count_unseen(25.0, 0.001)
    first.fault("burst pipe", "delivery")
    first.hold("the operator", "a leak")
    first.switch(False)
    assert first.flush() == ""
    problem = second.flush()
    assert problem.startswith(
        f"{file} cannot be written: process {os.getpid()} is already using it; end that process"
    )
    assert "--state, state_file" in problem
    second.release()
    second.count(100.0, 10.0, 1.0)
    third.hold("the page", until=clock.now + 60.0)
    third.fault("overload", "drive_fault")
    assert first.close() == ""
    assert second.acquire() and not second.acquire()
    assert (second.record.fault, second.record.fault_code) == ("burst pipe", "delivery")
    assert second.record.hold == ("the operator", "a leak", None)
    assert (second.record.day_volume, second.close()) == (0, "")
    assert third.acquire()
    assert (third.record.fault, third.record.fault_code) == ("overload", "drive_fault")
    assert third.record.hold == ("the page", "", None)  # the operator's has no end
    assert third.close() == ""


def test_use_of_the_day(tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is written every 10 s of use; time without the node counts, and the last 24 h slide.

    A system clock that is set, as by NTP without a battery, frees nothing, nor does a new start of
    the machine.
    """
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    ledger.flush()
    for _ in range(19):
        ledger.count(1.0, 0.5, 0.01)
    wait_for(lambda: written(file)["use"], 60, "a record")
    assert written(file)["use"] == [[5.0, 0.1]]
    for _ in range(81):
        ledger.count(1.0, 0.5, 0.01)
    ledger.flush()
    began, clock.now = clock.now, 1e6
    with monkeypatch.context() as rebooted:
        rebooted.setattr(ledger_module, "boot_id", lambda: "another")
        assert (read(file, clock).elapsed, read(file, clock).day_run) == pytest.approx((100, 50))
    clock.now = began + 3600
    assert read(file, lambda: 1000.0).elapsed == read(file, lambda: 9e9).elapsed
    again = read(file, clock)
    assert again.day_volume == pytest.approx(1.0)
    assert again.day_run == pytest.approx(50)
    assert again.elapsed == pytest.approx(3700)
    # 100 s after the start the first slot of 1800 s is in use, until it is 24 h old as a whole.
    assert again.clears_in(run=50.0) == pytest.approx(1800 + 86_400 - 3700)
    clock.now = began + 1800 + 86_400 - 101
    assert read(file, clock).day_run == pytest.approx(50)
    clock.now += 2
    after = read(file, clock)
    assert (after.day_volume, after.day_run, after.clears_in(run=50.0)) == (0, 0, 0)


class Use(NamedTuple):
    """A stretch of time: how long (s), whether the pump is wanted, and what happens at its end."""

    seconds: int
    wanted: bool
    restarts: bool
    down: int


@settings(max_examples=30, deadline=None)
@given(st.lists(st.builds(
    Use, st.integers(1, 30_000), st.booleans(), st.booleans(), st.integers(0, 90_000),
), max_size=20), st.sampled_from([0.5, 3.0]), st.sampled_from([600.0, 20_000.0]))
def test_no_24_h_have_more_use_than_the_limits(
    uses: list[Use], max_volume: float, max_run: float
) -> None:
    """By more than a tick's, in any window, also over restarts; and it is never off for a day."""
    tick, flow = 100.0, 1.5e-3
    clock = Clock()
    with TemporaryDirectory() as directory, pytest.MonkeyPatch.context() as patch:
        patch.setattr(ledger_module, "boot_time", clock)
        file = Path(directory) / "pump.json"
        ledger = Ledger(file, clock)
        pumped: list[float] = []  # when each tick of pumping ended
        for use in uses:
            for _ in range(max(1, use.seconds // 100)):
                clock.now += tick
                record = ledger.record
                over = record.day_volume >= max_volume or record.day_run >= max_run
                on = use.wanted and not over
                ledger.count(tick, tick if on else 0.0, tick * flow if on else 0.0)
                if over:
                    waits = record.clears_in(volume=max_volume, run=max_run)
                    assert 0 < waits <= 86_400 + 1800
                if on:
                    pumped.append(clock.now)
            if use.restarts:
                assert ledger.close() == ""
                clock.now += use.down
                ledger = Ledger(file, clock)
        assert ledger.close() == ""
    first = 0
    for number, end in enumerate(pumped):
        while pumped[first] <= end - 86_400:
            first += 1
        ticks = number - first + 1
        assert ticks * tick <= max_run + tick
        assert ticks * tick * flow <= max_volume + tick * flow


def test_any_record_fits_in_its_line(tmp_path: Path, clock: Clock) -> None:
    """With the longest texts, the most starts and the largest numbers; use is rounded up.

    A control character becomes a space, and so does half of a pair of UTF-16.
    """
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    for _ in range(60):
        ledger.count(1800.0, 1799.94, 123_456_789.01)
    ledger.record = replace(ledger.record, starts=(99_999_999_999.1,) * 3600)
    ledger.hold('"' * 1000, '"\\\x00' * 1000, 9e10 + 0.123456)
    ledger.fault("\ud800" + "\U0001f4a7" * 400, "speed_not_followed")
    assert ledger.close() == ""
    again = read(file, clock)
    assert (again.unknown, len(again.use), len(again.starts)) == ("", 49, 100)
    assert set(again.use) == {(1800.0, 123_500_000.0)}
    assert (again.hold_reason, again.fault) == ('"\\ ' * 70, " " + "\U0001f4a7" * 87)
    assert file.stat().st_size == 8192


@pytest.mark.parametrize(
    ("boot", "elapsed", "run"), [("this", 4.0, 4.0), ("another", 0.0, 25.0), ("", 0.0, 25.0)],
)
def test_what_no_one_saw_counts_at_worst(
    boot: str, elapsed: float, run: float, tmp_path: Path, clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Killed with the pump on: full flow since then, until the drive must have stopped (15 + 10 s).

    b sqrt(z_o + 55.2 - 13) = 1.29646769e-3 ... m3/s is the pump curve's maximum flow; Eq. (2).
    """
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    monkeypatch.setattr(ledger_module, "boot_id", lambda: boot and "this")
    ledger.switch(True)
    ledger.close()
    monkeypatch.setattr(ledger_module, "boot_id", lambda: boot)
    clock.now += 4.0
    site = PAPER_SITE
    flow = site.b * math.sqrt(site.z_o + site.c_hat - site.d)
    for attempt in range(2):  # counted once only
        ledger = Ledger(file, clock)
        PumpControl(site, settings_for(site), ledger, drive_stops_after=15.0)
        ledger.close()
        assert ledger.record.elapsed == elapsed, attempt
        assert ledger.record.day_run == pytest.approx(run), attempt
        assert ledger.record.day_volume == pytest.approx(run * flow, rel=1e-3), attempt


def test_a_broken_line_holds_the_pump(tmp_path: Path, clock: Clock) -> None:
    """Torn by a power cut: the other line counts, and the torn one could have had a hold."""
    file = tmp_path / "pump.json"
    for torn in range(2):
        ledger = Ledger(file, clock)
        ledger.release()
        ledger.count(1.0, 1.0, 0.5)
        ledger.close()
        before = ledger.record.day_volume
        content = bytearray(file.read_bytes())
        content[4096 * torn + 100] ^= 1
        file.write_bytes(content)
        again = Ledger(file, clock)
        unknown = again.record.unknown
        assert f"{file} cannot be read (line {torn + 1}: its checksum is wrong)" in unknown
        assert before - 0.5 <= again.record.day_volume <= before
        assert again.flush() == ""
        assert read(file, clock).unknown == unknown
        again.release()
        assert again.record.unknown  # only a reset accepts that
        again.clear_unknown()
        again.close()
        assert read(file, clock).unknown == ""
        for path in tmp_path.iterdir():
            path.unlink()


def lines_of(**changes: Any) -> bytes:
    """Return a file with right checksums; a change to ``...`` leaves its key out."""
    whole = {
        "hold_owner": "", "hold_reason": "", "hold_until": None, "unknown": "", "fault": "",
        "fault_code": "", "elapsed": 60.0, "use": [[30.0, 0.2]], "starts": [10.0], "on": False,
        "boot": "an earlier one", "boot_s": 50.0, "version": 1,
    } | changes
    lines = b""
    for sequence in (1, 2):
        content = {"sequence": sequence, **whole}
        text = json.dumps({key: value for key, value in content.items() if value is not ...})
        lines += (b"%08x " % zlib.crc32(text.encode()) + text.encode()).ljust(4095) + b"\n"
    return lines


@pytest.mark.parametrize(("changes", "problem"), [
    # A stop under another key, as in an older version, is not forgotten.
    ({"hold_owner": ..., "stopped": "by someone"}, "it does not contain hold_owner"),
    ({"fault": ...}, "it does not contain fault"),
    ({"version": 2}, "its format is 2, but this version reads 1"),
    ({"starts": [1.0, "2"]}, "starts must be a list of numbers"),
    ({"elapsed": math.nan}, "elapsed must be a number from 0 to 1e+11"),
    ({"use": [[0.0, -1e9]]}, "use must be at most 49 pairs of numbers"),
    ({"use": [[10**400, 0.0]]}, "use must be at most 49 pairs of numbers"),
    ({"use": [[1.0]]}, "use must be at most 49 pairs of numbers"),
    ({"use": [[0.0, 0.0]] * 50}, "use must be at most 49 pairs of numbers"),
    ({"on": 0}, "on must be true or false"),
    ({"fault": None}, "fault must be text"),
    ({"hold_until": 1e300}, "hold_until must be a number or null"),
    ({"sequence": 1.0}, "sequence must be a whole number above 0"),
    ({"sequence": 7}, "its sequence belongs to the other line"),
])
def test_a_wrong_key_is_an_unknown_state(
    changes: dict[str, Any], problem: str, tmp_path: Path, clock: Clock
) -> None:
    """Even with a right checksum; the node starts, and reports which key."""
    file = tmp_path / "pump.json"
    file.write_bytes(lines_of())
    assert (record := read(file, clock)).unknown == ""
    assert (record.day_run, record.day_volume, record.starts) == (30.0, 0.2, (10.0,))
    file.write_bytes(lines_of(**changes))
    assert problem in read(file, clock).unknown


def test_an_upgrade_needs_no_reset(tmp_path: Path, clock: Clock) -> None:
    """Keys of a later version are ignored, and those without harm may be missing.

    The use of a fixed day, as earlier versions counted it, counts as of now.
    """
    file = tmp_path / "pump.json"
    file.write_bytes(lines_of(future={"a": [1]}, hold_owner="the page", hold_reason="painting"))
    assert read(file, clock).hold == ("the page", "painting", None)
    missing = ("hold_reason", "hold_until", "fault_code", "use", "starts", "boot", "version")
    file.write_bytes(lines_of(**dict.fromkeys(missing, ...), fault="burst pipe"))
    record = read(file, clock)
    assert (record.unknown, record.fault, record.hold, record.starts) == (
        "", "burst pipe", ("", "", None), ()
    )
    file.write_bytes(lines_of(use=..., version=..., day_run=120.0, day_volume=0.4))
    record = read(file, clock)
    assert (record.unknown, record.day_run, record.day_volume) == ("", 120.0, 0.4)
    rig = Rig(file=file)
    assert rig.run(30, 1.0).state == "running"
    assert rig.ledger.close() == ""
    assert written(file)["version"] == 1


@pytest.mark.parametrize("content", [(), ("lost+found",)])
def test_empty_disk_mounted_for_the_bag_is_a_fresh_start(
    content: tuple[str, ...], tmp_path: Path
) -> None:
    """A new site starts although a disk is mounted where its bag will be."""
    for name in ("bag", *(f"bag/{each}" for each in content)):
        (tmp_path / name).mkdir()
    rig = Rig(file=tmp_path / "pump.json")
    decision = rig.run(30, 1.0)
    assert (decision.state, decision.interlocks) == ("running", {})
    rig.ledger.close()


@pytest.mark.parametrize("make", [
    lambda file: file.with_name("pump.json.new").write_bytes(lines_of()),
    lambda file: file.with_name("pump.json.broken").write_bytes(b"torn"),
    lambda file: file.with_name("pump.json.new").symlink_to("nowhere"),
    lambda file: file.mkdir(),
    lambda file: file.symlink_to("unmounted/pump.json"),
    lambda file: file.symlink_to(file),
    lambda file: file.with_name("pump.json.lock").touch(),
    lambda file: file.with_name("summary.json").write_text("{}"),
    lambda file: file.with_name("alarms.jsonl").touch(),
    lambda file: (file.with_name("bag") / "bag_0.mcap").mkdir(parents=True),
    lambda file: file.with_name("configuration").mkdir(),
    lambda file: file.with_name("bag").symlink_to("unmounted"),
], ids=["new", "broken", "second link", "directory", "link to nothing", "loop of links", "lock",
        "summary", "alarms", "bag", "configuration", "link to a missing bag"])
def test_what_shows_that_a_file_existed_is_an_unknown_state(
    make: Callable[[Path], Any], tmp_path: Path
) -> None:
    """No such state is a fresh start, also at the next start."""
    file = tmp_path / "pump.json"
    make(file)
    for _ in range(2):
        rig = Rig(file=file)
        decision = rig.run(30, 1.0)
        assert (decision.speed, list(decision.interlocks)) == (None, ["record_unknown"])
        rig.ledger.close()


def held(file: Path, clock: Clock, *, reason: str = "") -> bytes:
    """Return the content of a file before someone holds the pump, and the file is closed."""
    ledger = Ledger(file, clock)
    assert ledger.flush(20.0) == ""
    before = file.read_bytes()
    ledger.hold("the operator", reason)
    assert ledger.close() == ""
    return before


@pytest.mark.parametrize("how", ["removed", "older", "older of before it was made again", "other"])
def test_a_hold_is_not_forgotten_with_its_file(how: str, tmp_path: Path, clock: Clock) -> None:
    """A cleaner removed it, a restore put back an older copy, or the file of another site."""
    file, other = tmp_path / "here" / "pump.json", tmp_path / "there" / "pump.json"
    before = held(file, clock)
    held(other, clock)
    if how == "older of before it was made again":
        file.unlink()
        again = Ledger(file, clock)
        assert "is missing, although pump.json.lock exists" in again.record.unknown
        again.clear_unknown()
        again.hold("the operator")
        assert again.close() == ""
    file.unlink()
    if how != "removed":
        file.write_bytes(other.read_bytes() if how == "other" else before)
    words = "is missing" if how == "removed" else "it is an older copy, or belongs to another site"
    for _ in range(2):  # likewise at the next start
        rig = Rig(file=file)
        decision = rig.run(30, 1.0)
        assert next(iter(decision.interlocks)) == "record_unknown" and words in decision.why
        rig.ledger.close()
    rig = Rig(file=file)
    rig.control.reset()
    rig.ledger.release()
    assert rig.run(30, 1.0).state == "running"
    rig.ledger.close()
    assert read(file, clock).unknown == ""


def test_a_moved_site_needs_no_reset(tmp_path: Path, clock: Clock) -> None:
    """All its files, or the record alone, on a machine without any."""
    held(tmp_path / "a" / "pump.json", clock, reason="painting")
    (tmp_path / "a").rename(tmp_path / "b")
    assert read(tmp_path / "b" / "pump.json", clock).hold[1] == "painting"
    (tmp_path / "b" / "pump.json.lock").unlink()
    record = read(tmp_path / "b" / "pump.json", clock)
    assert (record.unknown, record.hold[1]) == ("", "painting")


@pytest.mark.parametrize("change", [
    Path.unlink, lambda file: file.write_bytes(b""), lambda file: file.write_bytes(lines_of()),
    lambda file: file.rename(file.with_name("elsewhere")), lambda file: os.truncate(file, 4096),
    lambda file: rmtree(file.parent),
], ids=["removed", "emptied", "replaced", "renamed", "cut", "with its directory"])
def test_a_file_that_another_program_changes_is_written_again(
    change: Callable[[Path], Any], tmp_path: Path, clock: Clock
) -> None:
    """The running node notices, and the hold is in the new file."""
    file = tmp_path / "site" / "pump.json"
    ledger = Ledger(file, clock)
    ledger.hold("the operator", "painting")
    assert ledger.flush(20.0) == ""
    for _ in range(3):
        assert not ledger.check_file()
        ledger.flush(20.0)
    change(file)
    wait_for(ledger.check_file, 20, "noticed")
    wait_for(lambda: not ledger.check_file(), 20, "written again")
    assert ledger.close() == ""
    record = read(file, clock)
    assert (record.unknown, record.hold) == ("", ("the operator", "painting", None))


def test_a_directory_in_place_of_the_file_is_reported(tmp_path: Path, clock: Clock) -> None:
    """It is not removed; the node goes on, and reports that it cannot write."""
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    assert ledger.flush(20.0) == ""
    file.unlink()
    file.mkdir()
    wait_for(ledger.check_file, 20, "noticed")
    assert "it exists but is not a file" in ledger.flush(20.0)
    file.rmdir()
    assert ledger.flush(20.0) == ""
    assert ledger.close() == ""


@pytest.mark.parametrize("content", [b"", b"\xff" * 8192, b"[" * 100_000])
def test_a_broken_file_stops_the_pump(content: bytes, tmp_path: Path) -> None:
    """Until someone resets it, who must look at the pump first; then all is well."""
    file = tmp_path / "pump.json"
    file.write_bytes(content)
    rig = Rig(file=file)
    decision = rig.run(30, 1.0)
    assert (decision.speed, decision.state) == (None, "fault")
    assert decision.why.startswith(f"{file} cannot be read (")
    assert ("it must be 8192 bytes long" in decision.why) == (len(content) != 8192)
    assert decision.why.endswith("check the pump, then reset the fault")
    assert rig.ledger.flush() == ""
    assert {path.name for path in tmp_path.iterdir()} == {"pump.json", "pump.json.lock"}
    assert Rig(file=file).run(30, 1.0).state == "fault"
    rig.ledger.hold("the operator")
    assert rig.step(1.0).why == f"{decision.why}; a hold by the operator"
    rig.ledger.release()
    assert rig.step(1.0).why == decision.why
    assert "cannot be read" in rig.control.reset()
    assert rig.run(30, 1.0).state == "running"
    rig.ledger.close()
    assert read(file, time.time).unknown == ""


def test_a_full_disk(tmp_path: Path, clock: Clock) -> None:
    """A hold is recorded, because its space was reserved when the file was made.

    If even that space is missing, this is reported, the control continues, and the file is made
    when there is room.
    """
    disk = tmp_path / "disk"
    with small_disk(disk, "64k"):
        ledger = Ledger(disk / "before.json", clock)
        assert ledger.flush() == ""
        with pytest.raises(OSError, match="No space left"):
            (disk / "rubbish").write_bytes(b"x" * 100_000)
        for number in range(3):
            ledger.hold("the page", f"reason {number}")
            ledger.fault(f"fault {number}", "delivery")
            assert ledger.flush() == ""
            again = read(disk / "before.json", clock)
            assert (again.hold_reason, again.fault) == (f"reason {number}", f"fault {number}")
        file = disk / "pump.json"
        rig = Rig(file=file)
        rig.ledger.hold("the operator")
        assert rig.step(1.0).state == "held"
        rig.ledger.release()
        assert rig.ledger.flush().startswith(
            f"{file} cannot be written: No space left on device; after a restart, holds"
        )
        assert rig.run(30, 1.0).state == "running"
        assert not list(disk.glob("pump.json*.new"))
        never = disk / "never.json"
        assert Ledger(never, clock).close()
        assert read(never, clock).unknown == ""  # the next start is a first one, too
        (disk / "rubbish").unlink()
        rig.run(30, 1.0)
        wait_for(lambda: rig.ledger.problem == "", 60, "the file")
        assert read(file, clock).starts


# Ends each of its children, as by a power cut, one file that is opened, made or renamed later than
# the one before, until one comes to its end; prints the number of that one.
_DIES = """
import os, signal, sys, time
from pathlib import Path
from greenroof_ros.live.pumping.ledger import Ledger
def die(event, arguments):
    global left
    if event in ("open", "os.rename", "os.mkdir", "os.link", "os.remove", "os.truncate"):
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
for number in range(50):
    child = os.fork()
    if child == 0:
        left = number
        sys.addaudithook(die)
        ledger = Ledger(Path(sys.argv[1]) / str(number) / "pump.json", time.time)
        ledger.flush(20.0)
        ledger.hold("the page")
        ledger.flush(20.0)
        ledger.close()
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    assert status in (0, signal.SIGKILL)
    if status == 0:
        print(number)
        break
"""


@pytest.mark.parametrize("content", [None, b"torn", lines_of(hold_owner="the page")],
                         ids=["first start", "broken", "held"])
def test_killed_at_each_step_it_forgets_no_hold(
    content: bytes | None, tmp_path: Path, clock: Clock
) -> None:
    """A first start begins fresh, or knows that it was begun; with any file there, it is off."""
    files = [tmp_path / str(number) / "pump.json" for number in range(50)]
    for file in files if content is not None else ():
        file.parent.mkdir()
        file.write_bytes(content or b"")
    done = subprocess.run(
        [sys.executable, "-c", _DIES, str(tmp_path)], check=True, capture_output=True, text=True
    )
    last = int(done.stdout)
    assert last > 2
    for file in files[:last]:
        record = read(file, clock)
        held = record.unknown or record.hold_owner == "the page"
        assert held or (content is None and (record == PumpRecord() or record.boot)), file
    assert read(files[last], clock).hold_owner == "the page"  # it was confirmed


def test_a_hold_ends_at_its_end_or_when_it_is_released(tmp_path: Path, clock: Clock) -> None:
    """By the system clock, even while no one runs; a reset does not end it."""
    file = tmp_path / "state.json"
    ledger = Ledger(file, clock)
    assert ledger.active_hold is None
    ledger.hold("the command line", "painting", clock.now + 3600)
    ledger.fault("", "")
    ledger.clear_unknown()
    assert ledger.close() == ""
    clock.now += 3599
    ledger = Ledger(file, clock)
    end = to_people(datetime.fromtimestamp(clock.now + 1).astimezone())
    assert ledger.active_hold is not None
    assert ledger.active_hold.sentence == f"a hold by the command line until {end}: painting"
    clock.now += 1
    assert ledger.active_hold is None
    assert ledger.close() == ""


@pytest.mark.parametrize(("first", "second", "end"), [
    (None, None, None), (None, 60.0, None), (60.0, None, None), (60.0, 30.0, 60.0),
    (60.0, 90.0, 90.0), (-1.0, 30.0, 30.0),
])
def test_a_later_request_never_shortens_a_hold(
    first: float | None, second: float | None, end: float | None, clock: Clock
) -> None:
    """It replaces owner and reason; an end that has passed does not count."""
    ledger = Ledger(None, clock)

    def at(seconds: float | None) -> float | None:
        return None if seconds is None else clock.now + seconds

    ledger.hold("the operator", "a leak", at(first))
    ledger.hold("the page", "", at(second))
    assert ledger.record.hold == ("the page", "", at(end))
    clock.now += 1e6
    assert bool(ledger.active_hold) == (end is None)


def test_a_slow_disk_stops_nothing(tmp_path: Path) -> None:
    """With a pipe that no one reads in place of the file: reported soon, and later an alarm."""
    rig = Rig(file=tmp_path / "pump.json")
    assert rig.ledger.flush(20.0) == ""
    os.mkfifo(tmp_path / "pump.json.new")
    (tmp_path / "pump.json").unlink()  # it is made again
    rig.run(30, 1.0)
    assert rig.decisions[-1].state == "running"
    assert rig.ledger.flush() in (
        f"{tmp_path}/pump.json is not yet on the disk; writing continues",
        f"{tmp_path}/pump.json could not be written within 2 s",  # on a busy machine
    )
    wait_for(
        lambda: rig.ledger.problem == f"{tmp_path}/pump.json could not be written within 2 s", 60,
        "the alarm",
    )
    # A ledger that must not write reports that, regardless of what the disk does.
    second = Ledger(tmp_path / "pump.json", time.time)
    assert f"process {os.getpid()} is already using it" in second.problem
    # The next attempt finds no pipe, and the disk's thread is free for other tests.
    (tmp_path / "pump.json.new").rename(tmp_path / "pipe").open().close()


def test_where_state_is_kept_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By the XDG base directory specification: $XDG_STATE_HOME, or ~/.local/state."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", "/var/state")
    assert state_directory() == Path("/var/state/greenroof_ros")
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_directory() == tmp_path / ".local/state/greenroof_ros"
