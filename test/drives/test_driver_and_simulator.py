"""The driver, made from the drive files, with the simulated drives, made from the manuals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from places import guarding
from simulators import Simulator, until

from greenroof_ros.drives.address import parse_address
from greenroof_ros.drives.drive_file import read_drive_file
from greenroof_ros.drives.exchange import DriveExchange

FREE = ("--port", "0", "--workbench", "0")


@contextmanager
def driver(make: str, drive: Simulator) -> Iterator[DriveExchange]:
    at = drive.ready.split()[2].rstrip(",")
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


@pytest.mark.parametrize(
    "make", ["abb_acs880", "danfoss_fc202", "grundfos_cim500", "schneider_atv630"]
)
def test_every_make_runs_stops_and_runs_again(make: str) -> None:
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.4", "--timeout", "2"
    ) as drive, driver(make, drive) as exchange:
        reach(exchange, drive, 0.6)
        # The watchdog of a CIM has a fixed time.
        assert exchange.snapshot.timeout_s == (5 if make == "grundfos_cim500" else 2)
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
        exchange.close()
        assert drive.speed() < 0.4
        until(lambda: drive.speed() == 0)


def test_a_motor_stops_by_the_drives_own_timeout_when_its_client_hears_no_more() -> None:
    """Half open: nothing gets through, so only the drive itself can stop it, 1 s later."""
    make = "abb_acs880"
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.2", "--timeout", "1"
    ) as drive, driver(make, drive) as exchange:
        reach(exchange, drive, 0.6)
        drive.inject("half_open")
        until(lambda: drive.speed() == 0)
        assert exchange.snapshot.problem != ""
    assert "communication timeout: nothing for 1 s" in drive.said


@pytest.mark.parametrize(
    ("place", "action"),
    # ETHL and SLL, EAV64332
    [(FREE, 7021), (("--serial", "pty", "--workbench", "0"), 7010)],
    ids=["ethernet", "serial"],
)
def test_each_port_of_an_altivar_has_a_timeout_of_its_own(
    place: tuple[str, ...], action: int
) -> None:
    """The one of the port in use is read, guards, trips with a code of its own, and is reset.

    2 s at the port in use, 10 s as delivered at the other.
    """
    with Simulator(
        "drive_simulator", "--drive", "schneider_atv630", *place, "--ramp", "0.2", "--timeout", "2"
    ) as drive:
        with driver("schneider_atv630", drive) as exchange:
            reach(exchange, drive, 0.6)
            assert (exchange.snapshot.timeout_s, exchange.snapshot.timeout_note) == (2, "")
            drive.inject("half_open")
            until(lambda: drive.speed() == 0, 15)
            drive.inject("none")
            until(lambda: exchange.snapshot.connected, 15)
            reach(exchange, drive, 0.4)
        drive.inject("timeout_off")
        with driver("schneider_atv630", drive) as exchange:
            until(lambda: exchange.snapshot.connected, 15)
            assert exchange.snapshot.timeout_s is None
            assert f"(register {action}) is 0: Ignore" in exchange.snapshot.timeout_note
    assert "communication timeout: nothing for 2 s" in drive.said


def test_modbus_rtu_over_a_pseudo_terminal() -> None:
    make = "danfoss_fc202"
    with Simulator(
        "drive_simulator", "--drive", make, "--serial", "pty", "--workbench", "0", "--ramp", "0.4"
    ) as drive, driver(make, drive) as exchange:
        reach(exchange, drive, 0.6)
        reach(exchange, drive, 0.0)
