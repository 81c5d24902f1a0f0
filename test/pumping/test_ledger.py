"""What survives a restart, a power cut, a full disk and a broken file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.pumping.ledger import Ledger
from greenroof_ros.pumping.settings import settings_for


class Clock:
    """A system clock that is set by hand."""

    now = 1_800_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_missing_file_is_a_fresh_record(tmp_path: Path, clock: Clock) -> None:
    """Nothing is held, and nothing is written before there is something."""
    ledger = Ledger(tmp_path / "state" / "pump.json", clock)
    assert (ledger.record.held, ledger.record.fault, ledger.problem) == ("", "", "")
    assert not (tmp_path / "state").exists()


def test_held_and_fault_are_written_at_once(tmp_path: Path, clock: Clock) -> None:
    """In a directory that is made for them, and nothing else is left in it."""
    file = tmp_path / "state" / "pump.json"
    ledger = Ledger(file, clock)
    ledger.hold("an operator stopped it")
    ledger.fault("the drive reports: overload")
    ledger.flush()
    again = Ledger(file, clock)
    assert again.record.held == "an operator stopped it"
    assert again.record.fault == "the drive reports: overload"
    again.hold("")
    again.fault("")
    again.flush()
    last = Ledger(file, clock).record
    assert (last.held, last.fault) == ("", "")
    assert [one.name for one in file.parent.iterdir()] == ["pump.json"]


def test_use_of_the_day(tmp_path: Path, clock: Clock) -> None:
    """Written each minute and at the end; time without the node counts for the day."""
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    for _ in range(100):
        ledger.count(1.0, 0.5, 0.01)
    deadline = time.monotonic() + 5
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert json.loads(file.read_text())["day_volume"] == pytest.approx(0.6)
    ledger.close()
    clock.now += 3600
    again = Ledger(file, clock).record
    assert again.day_volume == pytest.approx(1.0)
    assert again.day_run == pytest.approx(50)
    assert again.day_elapsed == pytest.approx(3700)
    clock.now += 23 * 3600
    after = Ledger(file, clock).record
    assert (after.day_volume, after.day_run) == (0, 0)
    assert after.day_elapsed == pytest.approx(100 + 24 * 3600 - 86_400)


def test_a_clock_that_goes_back_frees_nothing(tmp_path: Path, clock: Clock) -> None:
    """As that of a computer without a battery does."""
    file = tmp_path / "pump.json"
    ledger = Ledger(file, clock)
    ledger.count(1000.0, 10.0, 1.0)
    ledger.close()
    clock.now = 0.0
    assert Ledger(file, clock).record.day_elapsed == 1000
    assert Ledger(file, clock).record.day_volume == 1


GOOD = {
    "held": "", "fault": "", "day_elapsed": 1, "day_run": 0.5, "day_volume": 0.0,
    "written_at": 0.0,
}


def test_a_file_by_hand(tmp_path: Path, clock: Clock) -> None:
    """Whole numbers are numbers."""
    file = tmp_path / "pump.json"
    file.write_text(json.dumps(GOOD))
    assert Ledger(file, clock).record.held == ""
    assert Ledger(file, clock).record.day_elapsed == 1


@pytest.mark.parametrize(
    "content",
    [
        b"", b"{", b"null", b"[]", b"\xff\xfe", b"{}", b"[" * 100_000,
        json.dumps(GOOD | {"held": None}).encode(),
        json.dumps(GOOD | {"day_run": "1"}).encode(),
        json.dumps(GOOD | {"day_run": True}).encode(),
        json.dumps(GOOD | {"day_run": -1.0}).encode(),
        json.dumps(GOOD | {"day_volume": float("nan")}).encode(),
        json.dumps(GOOD | {"day_volume": 10**400}).encode(),
        json.dumps(GOOD | {"more": 1}).encode(),
    ],
)
def test_a_broken_file_holds_the_pump(content: bytes, tmp_path: Path) -> None:
    """Until somebody releases it, who is told to look at it first; then all is well."""
    file = tmp_path / "pump.json"
    file.write_bytes(content)
    rig = Rig(file=file)
    decision = rig.run(30, 1.0)
    assert (decision.speed, decision.state) == (None, "held")
    assert decision.why.startswith(f"{file} cannot be read (")
    assert decision.why.endswith("look at the pump, then release it")
    rig.control.hold(True)
    assert rig.step(1.0).why == decision.why
    rig.control.hold(False)
    assert rig.run(30, 1.0).state == "running"
    rig.ledger.flush()
    assert Ledger(file, time.time).record.held == ""


def test_an_unreadable_file_holds_the_pump(tmp_path: Path, clock: Clock) -> None:
    """A directory where the file should be."""
    assert "cannot be read" in Ledger(tmp_path, clock).record.held


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a disk that is always full")
def test_a_full_disk_stops_nothing(tmp_path: Path) -> None:
    """It is said with each decision, and no more once there is room again."""
    file = tmp_path / "pump.json"
    beside = tmp_path / "pump.json.new"
    beside.symlink_to("/dev/full")
    rig = Rig(file=file)
    rig.control.hold(True)
    assert rig.step(1.0).state == "held"
    rig.control.hold(False)
    rig.ledger.flush()
    assert rig.run(30, 1.0).state == "running"
    assert rig.decisions[-1].warning.startswith(
        f"{file} cannot be written: No space left on device; a restart would not know"
    )
    beside.unlink()
    rig.control.hold(True)
    rig.ledger.flush()
    assert rig.step(1.0).warning == ""
    assert Ledger(file, time.time).record.held == "an operator stopped it"


def test_killed_at_any_moment(tmp_path: Path) -> None:
    """Ten times, while it writes without a pause: what is there is always whole."""
    file = tmp_path / "pump.json"
    program = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from greenroof_ros.pumping.ledger import Ledger\n"
        "ledger = Ledger(Path(sys.argv[1]), time.time)\n"
        "while True:\n"
        "    ledger.hold('x' * 5000)\n"
        "    ledger.flush()\n"
    )
    for attempt in range(10):
        writer = subprocess.Popen([sys.executable, "-c", program, str(file)])
        deadline = time.monotonic() + 20
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(0.15 + 0.003 * attempt)
        os.kill(writer.pid, signal.SIGKILL)
        writer.wait()
        assert Ledger(file, time.time).record.held == "x" * 5000


def test_fault_and_stop_survive_the_pump(tmp_path: Path) -> None:
    """A second control on the same file is in the state of the first."""
    file = tmp_path / "pump.json"
    rig = Rig(file=file)
    rig.change = {"drive_fault": "overload"}
    rig.step(1.0)
    rig.control.hold(True)
    rig.ledger.flush()
    again = Rig(file=file)
    decision = again.run(30, 1.0)
    assert (decision.speed, decision.state) == (None, "fault")
    assert decision.why == "the drive reports: overload; an operator stopped it"
    assert again.control.reset() == "the drive reports: overload"
    assert again.run(30, 1.0).state == "held"
    again.control.hold(False)
    assert again.run(30, 1.0).state == "running"


def test_the_days_volume_survives_the_pump(tmp_path: Path) -> None:
    """What was pumped before counts after a restart."""
    file = tmp_path / "pump.json"
    limits = settings_for(PAPER_SITE, greatest_volume_per_day=0.5)
    rig = Rig(file=file, settings=limits)
    rig.run(45, 1.0)
    rig.ledger.close()
    again = Rig(file=file, settings=limits)
    again.run(200, 1.0)
    assert again.decisions[-1].state == "held"
    assert rig.delivered > 0.2
    assert rig.delivered + again.delivered == pytest.approx(0.5, abs=0.03)


def test_a_slow_disk_stops_nothing(tmp_path: Path) -> None:
    """A pipe that nobody reads, where the file should be: it is said after two seconds."""
    os.mkfifo(tmp_path / "pump.json.new")
    rig = Rig(file=tmp_path / "pump.json")
    rig.control.hold(True)
    rig.control.hold(False)
    rig.run(30, 1.0)
    assert rig.decisions[-1].state == "running"
    assert rig.decisions[-1].warning == f"{tmp_path}/pump.json could not be written within 2 s"
    (tmp_path / "pump.json.new").open().close()
