"""What survives a restart, a power cut, a full disk and a broken file."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from disks import small_disk
from graphs import wait_for
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.pumping.ledger import Ledger, Record, state_directory
from greenroof_ros.pumping.limits import settings_for
from greenroof_ros.pumping.pump_control import PumpControl


class Clock:
    """A system clock that is set by hand."""

    now = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def written(file: Path) -> dict[str, Any]:
    """Return the newest line of a file as a person reads it, as soon as it is there."""

    def newest() -> dict[str, Any]:
        try:
            lines = file.read_text().splitlines()
            records = [json.loads(line.split(maxsplit=1)[1]) for line in lines]
        except (FileNotFoundError, ValueError):  # it is being written
            return {}
        return max(records, key=lambda line: int(line["sequence"]))

    return wait_for(newest, 20, "the file")  # type: ignore[no-any-return]


def read(file: Path, clock: Callable[[], float]) -> Record:
    """Return what a new ledger reads, and release the file."""
    return Ledger(file, clock).record


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('"\\\x00' * 10_000, '"\\ ' * 116 + '"\\'),
        ("\ud800" + "\U0001f4a7" * 400, " " + "\U0001f4a7" * 87),
    ],
    ids=["escaped", "wide"],
)
def test_a_missing_file_is_a_fresh_record_and_is_made(
    text: str, expected: str, tmp_path: Path, clock: Clock
) -> None:
    """With its directories and its final size; only the lock file is beside it.

    The file has room for any text beside the last hundred starts in the third year.
    """
    file = tmp_path / "greenroof" / "state" / "pump.json"
    ledger = Ledger(file, clock)
    assert (ledger.record, ledger.why_not_kept(20.0)) == (Record(), "")
    assert file.stat().st_size == 8192
    ledger.count(1e8 + 0.5, 0.0, 0.0)
    ledger.record = replace(ledger.record, starts=(0.0,) * 3600)  # one a second in an hour
    for _ in range(101):
        ledger.switch(True)
    assert len(ledger.record.starts) == 3600
    ledger.fault(text, "delivery")
    ledger.stop(text)
    ledger.stop_on_page(True)
    assert ledger.why_not_kept(20.0) == ""
    again = read(file, clock)
    assert (again.fault, again.operator_stop, again.page_stop) == (expected, expected, True)
    assert (len(again.starts), file.stat().st_size) == (100, 8192)
    assert {path.name for path in file.parent.iterdir()} == {"pump.json", "pump.json.lock"}


def test_a_second_ledger_erases_nothing(tmp_path: Path, clock: Clock) -> None:
    """It reports who has the file; when that ledger has gone, it takes over what was written.

    A stop that was requested meanwhile counts, but not a release.
    """
    file = tmp_path / "pump.json"
    first = Ledger(file, clock)
    first.switch(True)
    assert first.why_not_kept() == ""
    second, third = Ledger(file, clock), Ledger(file, clock)
    assert not second.take()
    second.count_unseen(25.0, 0.001)
    first.fault("burst pipe", "delivery")
    first.stop("an operator stopped it")
    first.switch(False)
    assert first.why_not_kept() == ""
    problem = second.why_not_kept()
    assert problem.startswith(
        f"{file} cannot be written: process {os.getpid()} already uses it; end that process"
    )
    assert "--state, state_file" in problem
    second.stop("")
    second.count(100.0, 10.0, 1.0)
    third.stop("stopped here")
    third.fault("overload", "drive_fault")
    third.stop_on_page(True)
    assert first.close() == ""
    assert second.take() and not second.take()
    assert (second.record.fault, second.record.fault_code) == ("burst pipe", "delivery")
    assert second.record.operator_stop == "an operator stopped it"
    assert (second.record.day_volume, second.close()) == (0, "")
    assert third.take()
    assert (third.record.fault, third.record.fault_code) == ("overload", "drive_fault")
    assert (third.record.operator_stop, third.record.page_stop) == ("stopped here", True)
    assert third.close() == ""


def test_use_of_the_day(tmp_path: Path, clock: Clock) -> None:
    """It is written every 10 s of use; time without the node counts for the day.

    A clock that was set back, as without a battery, frees nothing.
    """
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    ledger.why_not_kept()
    for _ in range(19):
        ledger.count(1.0, 0.5, 0.01)
    wait_for(lambda: written(file)["day_volume"] > 0, 60, "a record")
    assert written(file)["day_volume"] == pytest.approx(0.1)
    for _ in range(81):
        ledger.count(1.0, 0.5, 0.01)
    ledger.why_not_kept()
    began, clock.now = clock.now, 0.0
    assert (read(file, clock).day_elapsed, read(file, clock).day_run) == pytest.approx((100, 50))
    clock.now = began + 3600
    again = read(file, clock)
    assert again.day_volume == pytest.approx(1.0)
    assert again.day_run == pytest.approx(50)
    assert again.day_elapsed == pytest.approx(3700)
    clock.now += 23 * 3600
    after = read(file, clock)
    assert (after.day_volume, after.day_run) == (0, 0)
    assert after.day_elapsed == pytest.approx(100 + 24 * 3600 - 86_400)


@pytest.mark.parametrize(
    ("down", "run"), [(4.0, 4.0), (-3600.0, 25.0)],
)
def test_what_nobody_saw_counts_at_worst(
    down: float, run: float, tmp_path: Path, clock: Clock
) -> None:
    """Killed with the pump on: full flow since then, until the drive must have stopped (15 + 10 s).

    b sqrt(z_o + 55.2 - 13) = 1.29646769e-3 ... m3/s is the pump curve's greatest flow; Eq. (2).
    """
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    ledger.switch(True)
    ledger.close()
    clock.now += down
    site = PAPER_SITE
    flow = site.b * math.sqrt(site.z_o + site.c_hat - site.d)
    for attempt in range(2):  # counted once only
        ledger = Ledger(file, clock)
        PumpControl(site, settings_for(site), ledger, drive_stops_after=15.0)
        ledger.close()
        assert ledger.record.elapsed == max(0.0, down), attempt
        assert ledger.record.day_run == pytest.approx(run), attempt
        assert ledger.record.day_volume == pytest.approx(run * flow), attempt


def test_a_broken_line_holds_the_pump(tmp_path: Path, clock: Clock) -> None:
    """Torn by a power cut: the other line counts, and the torn one could have been a stop."""
    file = tmp_path / "pump.json"
    for torn in range(2):
        ledger = Ledger(file, clock)
        ledger.stop("")
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
        assert again.why_not_kept() == ""
        assert read(file, clock).unknown == unknown
        again.stop("")
        again.close()
        assert read(file, clock).unknown == ""
        file.unlink()


def test_a_record_of_an_older_version_is_read(tmp_path: Path, clock: Clock) -> None:
    """It had no codes; its fault and the day's use remain valid."""
    old = {
        "sequence": 2, "held": "look at it", "fault": "burst pipe", "elapsed": 60.0,
        "day_run": 30.0, "day_volume": 0.2, "starts": [10.0], "on": False, "written_at": clock.now,
    }
    lines = b""
    for sequence in (1, 2):
        text = json.dumps(old | {"sequence": sequence}).encode()
        lines += (b"%08x " % zlib.crc32(text) + text).ljust(4095) + b"\n"
    file = tmp_path / "pump.json"
    file.write_bytes(lines)
    record = Ledger(file, clock).record
    assert (record.fault, record.fault_code, record.unknown) == ("burst pipe", "", "")
    assert (record.operator_stop, record.page_stop) == ("look at it", False)  # then called held
    assert (record.day_run, record.day_volume, record.starts) == (30.0, 0.2, (10.0,))


@pytest.mark.parametrize("content", [b"", b"\xff" * 8192, b"[" * 100_000])
def test_a_broken_file_stops_the_pump(content: bytes, tmp_path: Path) -> None:
    """Until somebody releases it, who must look at the pump first; then all is well."""
    file = tmp_path / "pump.json"
    file.write_bytes(content)
    rig = Rig(file=file)
    decision = rig.run(30, 1.0)
    assert (decision.speed, decision.state) == (None, "held")
    assert decision.why.startswith(f"{file} cannot be read (")
    assert ("it must be 8192 bytes long" in decision.why) == (len(content) != 8192)
    assert decision.why.endswith("check the pump, then release it")
    assert rig.ledger.why_not_kept() == ""
    assert (tmp_path / "pump.json.broken").read_bytes() == content
    assert Rig(file=file).run(30, 1.0).state == "held"
    rig.control.stop(True)
    assert rig.step(1.0).why == f"an operator stopped it; {decision.why}"
    rig.control.stop(False)
    assert rig.run(30, 1.0).state == "running"
    rig.ledger.close()
    assert read(file, time.time).unknown == ""
    # A directory in place of the file is left there.
    ledger = Ledger(tmp_path, time.time)
    assert "cannot be read (it is not a file)" in ledger.record.unknown
    assert "not a file" in ledger.why_not_kept()


def test_a_full_disk(tmp_path: Path, clock: Clock) -> None:
    """A stop is recorded, because its space was reserved when the file was made.

    If even that space is missing, this is reported, the control continues, and the file is made
    when there is room.
    """
    disk = tmp_path / "disk"
    with small_disk(disk, "64k"):
        ledger = Ledger(disk / "before.json", clock)
        assert ledger.why_not_kept() == ""
        with pytest.raises(OSError, match="No space left"):
            (disk / "rubbish").write_bytes(b"x" * 100_000)
        for number in range(3):
            ledger.stop(f"stop {number}")
            ledger.fault(f"fault {number}", "delivery")
            assert ledger.why_not_kept() == ""
            again = read(disk / "before.json", clock)
            assert (again.operator_stop, again.fault) == (f"stop {number}", f"fault {number}")
        file = disk / "pump.json"
        rig = Rig(file=file)
        rig.control.stop(True)
        assert rig.step(1.0).state == "held"
        rig.control.stop(False)
        assert rig.ledger.why_not_kept().startswith(
            f"{file} cannot be written: No space left on device; a restart would not know"
        )
        assert rig.run(30, 1.0).state == "running"
        (disk / "rubbish").unlink()
        rig.run(30, 1.0)
        wait_for(lambda: rig.ledger.problem == "", 60, "the file")
        assert read(file, clock).starts


def test_killed_at_any_moment(tmp_path: Path) -> None:
    """Three times, during continuous writing: the file is always intact."""
    file = tmp_path / "pump.json"
    program = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from greenroof_ros.pumping.ledger import Ledger\n"
        "ledger = Ledger(Path(sys.argv[1]), time.time)\n"
        "while True:\n"
        "    ledger.stop('x' * 350)\n"
        "    ledger.why_not_kept()\n"
    )
    before = 0
    for attempt in range(3):
        writer = subprocess.Popen([sys.executable, "-c", program, str(file)])
        wait_for(
            lambda: written(file)["sequence"] > before + 10, 60, "its work"  # noqa: B023
        )
        time.sleep(0.01 * attempt)
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
        before = written(file)["sequence"]
        assert read(file, time.time).operator_stop == "x" * 350


def test_a_pause_is_kept_until_its_date(tmp_path: Path, clock: Clock) -> None:
    """By the system clock, even while nobody runs; a release and a reset do not end it."""
    file = tmp_path / "state.json"
    ledger = Ledger(file, clock)
    ledger.pause(clock.now + 3600)
    ledger.stop("an operator stopped it")
    ledger.stop("")
    ledger.fault("", "")
    assert ledger.close() == ""
    clock.now += 3599
    ledger = Ledger(file, clock)
    assert ledger.paused
    clock.now += 1
    assert not ledger.paused
    # If a second ledger gets the file later, its own pause counts.
    later = Ledger(file, clock)
    later.pause(clock.now + 60)
    assert ledger.close() == ""
    assert later.take() and later.paused
    later.pause(0.0)
    assert later.close() == ""
    assert written(file)["pause_until"] == 0.0


def test_a_slow_disk_stops_nothing(tmp_path: Path) -> None:
    """With a pipe that nobody reads in place of the file: reported soon, and later an alarm."""
    os.mkfifo(tmp_path / "pump.json.new")
    rig = Rig(file=tmp_path / "pump.json")
    rig.run(30, 1.0)
    assert rig.decisions[-1].state == "running"
    began = time.monotonic()
    assert rig.ledger.why_not_kept() in (
        f"{tmp_path}/pump.json is not yet on the disk; writing continues",
        f"{tmp_path}/pump.json could not be written within 2 s",  # on a busy machine
    )
    assert time.monotonic() - began < 1.5
    wait_for(
        lambda: rig.ledger.problem == f"{tmp_path}/pump.json could not be written within 2 s", 20,
        "the alarm",
    )
    # A ledger that must not write reports that, whatever the disk does.
    second = Ledger(tmp_path / "pump.json", time.time)
    assert f"process {os.getpid()} already uses it" in second.problem
    # The next attempt finds no pipe, and the disk's thread is free for other tests.
    (tmp_path / "pump.json.new").rename(tmp_path / "pipe").open().close()


def test_where_state_is_kept_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By the XDG base directory specification: $XDG_STATE_HOME, or ~/.local/state."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", "/var/state")
    assert state_directory() == Path("/var/state/greenroof_ros")
    monkeypatch.delenv("XDG_STATE_HOME")
    assert state_directory() == tmp_path / ".local/state/greenroof_ros"
