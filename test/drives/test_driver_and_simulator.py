"""The driver, made from the drive files, with the simulated drives, made from the manuals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from modbus_wire import Wire, frame
from places import guarding
from simulators import Bus, Simulator, until

from greenroof_ros.drives.drive import why_no_simulator
from greenroof_ros.drives.drive_file import find_drive_file, read_drive_file
from greenroof_ros.drives.exchange import DriveExchange
from greenroof_ros.drives.modbus_line import parse_address

MAKES = ("abb_acs880", "danfoss_fc202", "grundfos_cim500", "schneider_atv630")
FREE = ("--port", "0", "--workbench", "0")


@contextmanager
def driver(make: str, drive: Simulator) -> Iterator[DriveExchange]:
    """Run a driver until it is closed."""
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


@pytest.mark.parametrize("make", MAKES)
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


@pytest.mark.parametrize(
    ("make", "place"),
    [*((make, FREE) for make in MAKES), (MAKES[1], ("--serial", "pty", "--workbench", "0"))],
)
def test_every_make_says_that_it_is_a_simulator(make: str, place: tuple[str, ...]) -> None:
    """At a port, at a gateway's, where the make has none, and on a line."""
    file = read_drive_file(find_drive_file(make))
    with Simulator("drive_simulator", "--drive", make, *place) as drive:
        address = parse_address(drive.ready.split()[2].rstrip(","))
        assert why_no_simulator(file, address) == ""
        drive.inject("exception")
        assert "refused with exception 4" in why_no_simulator(file, address)


def test_a_line_that_is_no_pseudo_terminal_and_another_server_are_no_simulator() -> None:
    file = read_drive_file(find_drive_file("danfoss_fc202"))
    assert "neither at loopback" in why_no_simulator(file, parse_address("/dev/ttyS0"))
    name = frame("0001 0000 0016 01 2B 0E 01 01 00 00 02 00 08") + b"Pymodbus" + b"\1\2PM"
    wire = Wire(lambda _request: [(0.0, name)])
    try:
        why = why_no_simulator(file, parse_address(wire.gateway))
        assert why.endswith("identifies itself as 'Pymodbus', 'PM'")
    finally:
        wire.close()


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


# --- a drive that refuses to be stopped -----------------------------------------------------------


def keep_asking(exchange: DriveExchange, speed: float, reached: Callable[[], bool],
                within: float) -> None:
    """Ask for a speed until something is so."""

    def asked() -> bool:
        exchange.demand(speed)
        return reached()

    until(asked, within)


@pytest.mark.parametrize(
    ("make", "fault", "place"),
    [
        ("abb_acs880", "refused_writes", FREE), ("grundfos_cim500", "exception", FREE),
        ("schneider_atv630", "refused_writes", ("--serial", "pty", "--workbench", "0")),
    ],
)
def test_a_drive_for_which_a_refused_order_is_a_sign_of_life_stops_by_itself(
    make: str, fault: str, place: tuple[str, ...]
) -> None:
    """Exception 6, busy, to all; the drive's own timeout needs as much silence to fall.

    Where it counts as off, as an ABB's of this kind, the silence is that of the limit, 10 s.
    """
    timeout = 5 if make == "grundfos_cim500" else 2  # the one of a Grundfos cannot be set
    silence = 11 if make == "abb_acs880" else timeout + 1
    with Simulator(
        "drive_simulator", "--drive", make, *place, "--ramp", "0.4", "--timeout", "2"
    ) as drive:
        if make == "abb_acs880":
            with Bus(drive.ports[0]) as panel:
                panel.write(5814, 1)  # 58.15 = any message
        with driver(make, drive) as exchange:
            reach(exchange, drive, 0.6)
            drive.inject(fault, 6)
            keep_asking(exchange, 0.6, lambda: drive.speed() == 0, 60)
            assert f"so nothing is sent for {silence} s" in exchange.snapshot.problem
            assert exchange.snapshot.status is None
            assert ("is 1: Any message" in exchange.snapshot.timeout_note) == (silence == 11)
            drive.inject("none")
            keep_asking(exchange, 0.6, lambda: drive.speed() > 0.5, 60)
    assert f"communication timeout: nothing for {timeout} s" in drive.said


@pytest.mark.parametrize("make", MAKES)
def test_a_drive_that_acknowledges_stop_and_runs_on_stops_by_itself(
    make: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Judged after 2 s instead of 10: writing *stop* on and on would keep its timeout alive."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.RUNS_ON_S", 2.0)
    timeout = 5 if make == "grundfos_cim500" else 2
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.4", "--timeout", "2"
    ) as drive, driver(make, drive) as exchange:
        reach(exchange, drive, 0.6)
        drive.inject("runs_on")
        exchange.demand(None)
        until(lambda: "acknowledges *stop*" in exchange.snapshot.problem, 20)
        assert drive.speed() == pytest.approx(0.6, abs=1e-3)
        assert f"so nothing is sent for {timeout + 1} s" in exchange.snapshot.problem
        until(lambda: drive.speed() == 0, 20)
        until(lambda: exchange.snapshot.connected, 20)
        reach(exchange, drive, 0.4)
        reach(exchange, drive, 0.0)
    assert f"communication timeout: nothing for {timeout} s" in drive.said


# --- somebody else --------------------------------------------------------------------------------

# What another client writes, as of the makers' manuals (see test_wire.py): run, and stop.
WORDS = {
    "abb_acs880": (0, 0x047F, 0x047E), "danfoss_fc202": (49999, 0x047C, 0x043C),
    "grundfos_cim500": (100, 0x0003, 0x0001), "schneider_atv630": (8501, 0x000F, 0x0007),
}


@pytest.mark.parametrize("make", WORDS)
def test_somebody_else_who_writes_run_or_stop_has_the_drive_stopped(
    make: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one writes more than once: a word that is overwritten at once is not seen."""
    monkeypatch.setattr("greenroof_ros.drives.exchange.INTRUDER_PAUSE_S", 2.0)
    address, run, stop = WORDS[make]
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.4", "--timeout", "2"
    ) as drive, Bus(drive.ports[0]) as other, driver(make, drive) as exchange:
        reach(exchange, drive, 0.6)
        reach(exchange, drive, 0.0)
        assert exchange.snapshot.errors == 0

        def caught() -> bool:
            return "somebody else writes to the drive" in exchange.snapshot.problem

        def meddle(word: int, speed: float | None) -> None:
            """Write a word until ours has noticed."""
            errors = exchange.snapshot.errors

            def noticed() -> bool:
                exchange.demand(speed)
                other.write(address, word)
                time.sleep(0.03)
                return exchange.snapshot.errors > errors

            until(noticed, 5)
            assert caught()

        # Ours says stop; the other one, run.
        meddle(run, None)
        assert f"control word is 0x{run:04X}, and 0x{stop:04X} was" in exchange.snapshot.problem
        until(lambda: drive.speed() == 0 and not caught(), 6)
        # Ours says run; the other one, stop, and for longer than the pause run again and again.
        reach(exchange, drive, 0.6)
        meddle(stop, 0.6)
        began = time.monotonic()
        while time.monotonic() - began < 4:
            keep_asking(exchange, 0.6, lambda: drive.speed() == 0, 3)
            last = time.monotonic()
            meddle(run, 0.6)
        # It has gone: the drive runs again, after the pause.
        keep_asking(exchange, 0.6, lambda: drive.speed() == 0, 3)
        keep_asking(exchange, 0.6, lambda: drive.speed() > 0.5, 10)
        assert time.monotonic() - last > 2.0
        assert exchange.snapshot.connected and not caught()
