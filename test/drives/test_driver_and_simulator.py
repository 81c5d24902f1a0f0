"""The driver, made from the drive files, with the simulated drives, made from the manuals."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from places import guarding
from simulators import Bus, Simulator, until

from greenroof_ros.drives.drive import Drive
from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange
from greenroof_ros.drives.modbus_line import parse_address

FREE, SERIAL = ("--port", "0", "--workbench", "0"), ("--serial", "pty", "--workbench", "0")
# Where another client writes, and what, by the makers' manuals (see test_wire.py): run, and stop.
WORDS = {
    "abb_acs880": (0, 0x047F, 0x047E), "danfoss_fc202": (49999, 0x047C, 0x043C),
    "grundfos_cim500": (100, 0x0003, 0x0001), "schneider_atv630": (8501, 0x000F, 0x0007),
}


def place_of(drive: Simulator) -> str:
    """Return the address that a simulator says is the drive's."""
    return drive.ready.split()[2].rstrip(",")


@contextmanager
def driver(make: str, at: str) -> Iterator[DriveExchange]:
    """Run a driver until it is closed."""
    with TemporaryDirectory() as place:
        file = read_drive_file(Path(guarding(make, Path(place))))
    exchange = DriveExchange(file, parse_address(at), period_s=0.1, dead_man_s=1.0)
    exchange.start()
    try:
        yield exchange
    finally:
        exchange.close()


def reach(exchange: DriveExchange, drive: Simulator, speed: float) -> None:
    """Ask for a speed until motor and driver both say that it is there."""

    def there() -> bool:
        exchange.demand(speed or None)
        status = exchange.snapshot.status
        return (
            drive.speed() == pytest.approx(speed, abs=1e-3)
            and status is not None and status.speed == pytest.approx(speed, abs=2e-3)
        )

    until(there, 8)


@contextmanager
def simulated(make: str, *place: str) -> Iterator[Simulator]:
    """Run a drive with a ramp of 0.4 s and a timeout of 2 s; that of a CIM is fixed, 5 s."""
    with Simulator(
        "drive_simulator", "--drive", make, *(place or FREE), "--ramp", "0.4", "--timeout", "2"
    ) as drive:
        yield drive


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judge whether a drive runs on after 2 s instead of 10, and wait 2 s for an intruder to go."""
    for name in ("RUNS_ON_S", "INTRUDER_PAUSE_S"):
        monkeypatch.setattr(f"greenroof_ros.drives.exchange.{name}", 2.0)


def meddle(
    exchange: DriveExchange, other: Bus, make: str, word: int, speed: float | None
) -> None:
    """Write a word until ours has noticed: one that is overwritten at once is not seen."""
    errors = exchange.snapshot.errors

    def noticed() -> bool:
        exchange.demand(speed)
        other.write(WORDS[make][0], word)
        time.sleep(0.03)
        return exchange.snapshot.errors > errors

    until(noticed, 5)
    assert "somebody else writes to the drive" in exchange.snapshot.problem


@pytest.mark.parametrize("make", WORDS)
def test_every_make_runs_stops_and_is_left_when_it_does_not(make: str) -> None:
    """A fault and its reset; another one's *run*; and a stop that is acknowledged and no more.

    While another one writes *run*, and for the pause after its last word, the drive is stopped.
    It says that it is a simulator, at a port, or at a gateway's where the make has none. Writing
    *stop* on and on would keep its own timeout alive, so it is left in silence.
    """
    timeout = 5 if make == "grundfos_cim500" else 2
    _, run, stop = WORDS[make]
    with simulated(make) as drive, driver(make, place_of(drive)) as exchange:
        exchange.only_simulator()
        reach(exchange, drive, 0.6)
        assert exchange.snapshot.timeout_s == timeout
        reach(exchange, drive, 0.0)
        reach(exchange, drive, 0.4)
        drive.inject("drive_fault")
        until(lambda: exchange.snapshot.status is not None and exchange.snapshot.status.fault != "")
        until(lambda: drive.speed() == 0)
        drive.inject("none")
        exchange.demand(None)
        exchange.reset()
        until(lambda: exchange.snapshot.status is not None and exchange.snapshot.status.fault == "")
        reach(exchange, drive, 0.4)
        reach(exchange, drive, 0.0)
        with Bus(drive.ports[0]) as other:
            for speed in (None, 0.6):  # the second time before the pause is over
                meddle(exchange, other, make, run, speed)
                last = time.monotonic()
                assert f"word is 0x{run:04X}, and 0x{stop:04X} was" in exchange.snapshot.problem
                until(lambda: drive.speed() == 0, 3)
        reach(exchange, drive, 0.6)
        assert time.monotonic() - last > 2.0 and exchange.snapshot.second_master == ""
        drive.inject("runs_on")
        exchange.demand(None)
        until(lambda: "acknowledges *stop*" in exchange.snapshot.problem, 20)
        assert drive.speed() == pytest.approx(0.6, abs=1e-3)
        assert f"so nothing is sent for {timeout + 1} s" in exchange.snapshot.problem
        until(lambda: drive.speed() == 0, 20)
        until(lambda: exchange.snapshot.connected, 20)
        reach(exchange, drive, 0.4)
        exchange.close()
        assert drive.speed() < 0.4
        until(lambda: drive.speed() == 0)
    assert f"communication timeout: nothing for {timeout} s" in drive.said


def test_a_drive_on_a_line_says_that_it_is_a_simulator() -> None:
    with simulated("danfoss_fc202", *SERIAL) as program:
        file = read_drive_file(find_drive_file("danfoss_fc202"))
        drive = Drive(file, parse_address(place_of(program)))
        drive.line.connect()
        assert drive.why_no_simulator() == ""
        drive.line.close()
