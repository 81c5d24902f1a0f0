"""The driver, made from the drive files, with the simulated drives, made from the manuals."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from places import guarding
from simulators import Simulator, until

from greenroof_ros.drives.drive import Drive, DriveStatus
from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange, State
from greenroof_ros.drives.modbus_line import parse_address


def simulated(make: str, *place: str) -> Simulator:
    """Run a drive with a ramp of 0.4 s and a timeout of 2 s; that of a CIM is fixed, 5 s."""
    return Simulator(
        "drive_simulator", "--drive", make, *(place or ("--port", "0")), "--workbench", "0",
        "--ramp", "0.4", "--timeout", "2",
    )


def place_of(drive: Simulator) -> str:
    """Return the address that a simulator says is the drive's."""
    return drive.ready.split()[2].rstrip(",")


@pytest.mark.parametrize(
    ("make", "timeout"),
    [("abb_acs880", 2), ("danfoss_fc202", 2), ("grundfos_cim500", 5), ("schneider_atv630", 2)],
)
def test_every_make_runs_stops_and_is_left_when_it_does_not(
    make: str, timeout: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fault and its reset, and a stop that is acknowledged and no more; seen after 2 s here.

    It says that it is a simulator, at a port, or at a gateway's where the make has none. Writing
    *stop* on and on would keep its own timeout alive, so it is left in silence.
    """
    monkeypatch.setattr("greenroof_ros.drives.exchange.RUNS_ON_S", 2.0)
    file = read_drive_file(Path(guarding(make, tmp_path)))
    with simulated(make) as drive, closing(
        DriveExchange(file, parse_address(place_of(drive)), period_s=0.1)
    ) as exchange:

        def said(what: Callable[[DriveStatus], bool]) -> bool:
            return exchange.snapshot.status is not None and what(exchange.snapshot.status)

        def reach(speed: float) -> None:
            """Ask for a speed until motor and driver both say that it is there."""

            def there() -> bool:
                exchange.demand(speed or None)
                return drive.speed() == pytest.approx(speed, abs=1e-3) and said(
                    lambda status: status.speed == pytest.approx(speed, abs=2e-3)
                )

            until(there, 8)

        exchange.only_simulator()
        exchange.start()
        reach(0.6)
        assert exchange.snapshot.timeout_s == timeout
        reach(0.0)
        reach(0.4)
        drive.inject("drive_fault")
        until(lambda: said(lambda status: status.fault != "") and drive.speed() == 0)
        drive.inject("none")
        exchange.demand(None)
        exchange.reset()
        until(lambda: said(lambda status: status.fault == ""))
        reach(0.6)
        drive.inject("runs_on")
        exchange.demand(None)
        until(lambda: said(lambda status: "acknowledges *stop*" in status.fault), 20)
        assert exchange.snapshot.state is State.STOPPING  # its cause is seen before the silence
        until(lambda: "acknowledges *stop*" in exchange.snapshot.problem, 20)
        assert drive.speed() == pytest.approx(0.6, abs=1e-3)
        assert f"so nothing is sent for {timeout + 1} s" in exchange.snapshot.problem
        until(lambda: drive.speed() == 0, 20)
        until(lambda: exchange.snapshot.connected, 20)
        reach(0.4)
        exchange.close()
        assert drive.speed() < 0.4
        until(lambda: drive.speed() == 0)
    assert f"communication timeout: nothing for {timeout} s" in drive.said


def test_a_drive_on_a_line_says_that_it_is_a_simulator() -> None:
    with simulated("danfoss_fc202", "--serial", "pty") as program:
        file = read_drive_file(find_drive_file("danfoss_fc202"))
        drive = Drive(file, parse_address(place_of(program)))
        drive.line.connect()
        assert drive.why_no_simulator() == ""
        drive.line.close()
