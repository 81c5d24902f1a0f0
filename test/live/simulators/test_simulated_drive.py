"""The simulated drive: its settings, with the test's own clock; and as a program, by the driver.

The driver shows how each make obeys; test_wire.py checks the driver's words against the manuals.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext, suppress
from functools import partial
from pathlib import Path

import pytest
from graphs import free_ports
from paper import PAPER_SITE
from places import guarding
from rig_simulators import DEFAULT, DriveBench, FaultyDrive, faulty_drive
from simulators import Simulator, until

from greenroof_ros.live.devices.drive import Drive, DriveEndpoint
from greenroof_ros.live.devices.drive_file import find_drive_file, read_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange
from greenroof_ros.live.devices.modbus_line import (
    Address,
    DriveError,
    parse_address,
    parse_drive_address,
)
from greenroof_ros.live.simulators.simulated_drive import DriveSettings

FREE = ("--port", "0", "--workbench", "0")


def make_of(name: str, clock: Callable[[], float], **settings: float | None) -> FaultyDrive:
    """Return a drive that is not on any wire."""
    file = read_drive_file(find_drive_file(name))
    return faulty_drive(file, DriveSettings(**settings), clock=clock)  # type: ignore[arg-type]


# --- settings -------------------------------------------------------------------------------------


def test_a_drive_that_reports_its_flow_follows_the_sites_curve() -> None:
    """By hand, at half speed: (0.25 x 55.2 + level - 16)^0.5 x 1.29646e-3 m3/s.

    At 3 / 1.3 = 2.3077 m that is 4.255e-4 m3/s = 1.53 m3/h; at 3 m 1.1596e-3 m3/s = 4.17 m3/h.
    """
    file, free = read_drive_file(find_drive_file("grundfos_cim500")), Address("127.0.0.1", 0)
    settings = DriveSettings(ramp_s=1e6)
    bench = DriveBench(file, settings, free, free, PAPER_SITE)
    bench.drive.speed = 0.5
    assert bench.drive.registers()[301] == 15
    bench.write_register(5, 30_000)
    assert bench.drive.registers()[301] == 42


@pytest.mark.parametrize(
    ("make", "delivered", "address", "off"),
    [
        # 3AUA0000085967: 58.14 = 0, no action; 58.16 = 3.0 s.
        ("abb_acs880", {5813: 0, 5815: 30}, 5813, 0),
        # MG20Z102: 8-04 Off, 8-03 60.0 s.
        ("danfoss_fc202", {8039: 0, 8030: 600}, 8039, 0),
        # Functional profile, 9.4: the watchdog 00012 is 0.
        ("grundfos_cim500", {11: 0}, 11, 0),
        # EAV64332: SLL and, on Ethernet, ETHL are 1, freewheel; TTO and TTOB 10.0 s.
        ("schneider_atv630", {7010: 1, 6005: 100, 7021: 1, 64415: 100}, 7010, 0),
    ],
)
def test_as_delivered_the_timeout_is_the_makers_and_off_is_read_back(
    make: str, delivered: dict[int, int], address: int, off: int
) -> None:
    registers = make_of(make, lambda: 0.0, timeout_s=None).registers()
    assert {name: registers[name] for name in delivered} == delivered
    drive = make_of(make, lambda: 0.0, timeout_s=3.0)
    assert drive.registers()[address] != off
    drive.inject("timeout_off", 0)
    assert drive.registers()[address] == off


def test_abb_guards_nothing_for_30_s_after_power_up() -> None:
    """Power-up at 10 s, boot until 12 s, so guarded from 42 s on; fault 0x6681 in 04.01."""
    now = [10.0]
    drive = make_of("abb_acs880", lambda: now[0], timeout_s=3.0, ramp_s=1.0)
    drive.boot_s = 2.0
    drive.power_cycle()
    for now[0], answers in ((11.99, False), (12.0, True), (13.0, True)):
        assert drive.answers is answers
    for address, word in ((0, 0x047E), (1, 10_000), (0, 0x047F)):
        assert drive.write(address, [word]) is None
    for now[0], speed in ((41.9, 0.5), (44.5, 0.0)):
        drive.advance()
        assert drive.speed == speed
    assert drive.registers()[400] == 0x6681


# --- what can go wrong on the wire, as the driver sees it -----------------------------------------


@pytest.fixture(scope="module")
def shared() -> Iterator[Simulator]:
    """A drive on TCP."""
    port = free_ports(1)[0]
    with Simulator("drive_simulator", "--drive", "abb_acs880", "--port", str(port)) as drive:
        assert drive.ports[0] == port
        yield drive


@pytest.fixture
def driver(shared: Simulator) -> Iterator[Drive]:
    """A driver that is connected to it, without a fault."""
    shared.inject("none")
    at = parse_address(shared.address)
    drive = Drive(read_drive_file(find_drive_file("abb_acs880")), at, 0.5)

    def connects() -> bool:
        with suppress(DriveError):  # its port may be about to open again
            drive.line.connect()
        return drive.line.connected

    until(connects)
    yield drive
    drive.line.close()
    shared.inject("none")


def test_it_listens_on_loopback_alone(shared: Simulator) -> None:
    listening = [line.split()[1:4] for line in Path("/proc/net/tcp").read_text().splitlines()]
    ours = {f"{port:04X}" for port in shared.ports}
    assert {at for at, _, state in listening if state == "0A" and at[-4:] in ours} == {
        f"0100007F:{port}" for port in ours
    }


@pytest.mark.parametrize(
    ("fault", "parameter", "error"),
    [
        ("none", DEFAULT, ""), ("slow", DEFAULT, ""), ("split", DEFAULT, ""),
        *((fault, DEFAULT, "no valid answer within 0.5 s")
          for fault in ("half_open", "silence", "late", "garbage", "wrong_unit")),
        ("wrong_function", DEFAULT, "the answer has function 4, not 3"),
        ("wrong_length", DEFAULT, "reading register 3: "),
        ("exception", 6, "refused with exception 6"),
        ("refused_writes", 6, "writing 0x047E to register 0: refused with exception 6"),
        ("absurd_value", 0x8001, "is -32767: -1.63835 share"),
        ("dropped", DEFAULT, "the connection was closed"),
        ("refused", DEFAULT, "the connection was closed"),
        ("echo", DEFAULT, "the line returns what was sent"),
    ],
)
def test_faults_of_the_wire(
    shared: Simulator, driver: Drive, fault: str, parameter: int, error: str
) -> None:
    """A slow answer in time, and an answer byte by byte, are valid."""
    shared.inject(fault, parameter)
    with pytest.raises(DriveError, match=re.escape(error)) if error else nullcontext():
        if fault == "refused_writes":
            driver.stop()
        assert driver.read().at_rest
    if fault == "refused":
        with pytest.raises(DriveError, match="cannot connect"):
            driver.line.connect()


@pytest.mark.parametrize(("fault", "value"), [("silence", 500), ("half_open", 0)])
def test_silence_obeys_and_half_open_does_not(
    shared: Simulator, driver: Drive, fault: str, value: int
) -> None:
    driver.line.write(1, 0)
    shared.inject(fault)
    with pytest.raises(DriveError, match="no valid answer"):
        driver.line.write(1, 500)
    shared.inject("none")
    assert driver.line.read(1, 1) == [value]


def test_what_is_not_there_is_refused_by_the_specifications_exception(
    shared: Simulator, driver: Drive
) -> None:
    """An illegal address is exception 2; a device missing behind the gateway is exception 11."""
    for ask in (partial(driver.line.read, 0x7000, 1), partial(driver.line.write, 3, 1)):
        with pytest.raises(DriveError, match="refused with exception 2"):
            ask()
    stranger = Drive(driver.file, parse_drive_address(f"{shared.address},5", "at"), 0.5)
    with closing(stranger.line):
        stranger.line.connect()
        with pytest.raises(DriveError, match="refused with exception 11"):
            stranger.read()


# --- the program ----------------------------------------------------------------------------------


def test_rtu_over_a_pseudo_terminal() -> None:
    """Without power the line is silent."""
    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--serial", "pty", "--workbench", "0",
        "--boot", "0.5",
    ) as drive:
        file = read_drive_file(find_drive_file("abb_acs880"))
        driver = Drive(file, parse_address(drive.address), 0.2)
        with closing(driver.line):
            driver.line.connect()
            drive.power_cycle()
            with pytest.raises(DriveError, match="no valid answer"):
                driver.read()
            time.sleep(0.5)
            assert driver.read().at_rest


# --- with the driver, by the drive files ----------------------------------------------------------


@pytest.mark.parametrize(
    "make", ["abb_acs880", "danfoss_fc202", "grundfos_cim500", "schneider_atv630"]
)
def test_with_the_driver_every_make_runs_and_stops_also_by_its_own_timeout(
    make: str, tmp_path: Path
) -> None:
    """And its fault can be reset. The timeout of a CIM is fixed."""
    timeout = 5 if make == "grundfos_cim500" else 2
    file = read_drive_file(Path(guarding(make, tmp_path)))
    with Simulator(
        "drive_simulator", "--drive", make, *FREE, "--ramp", "0.4", "--timeout", "2"
    ) as drive, closing(
        DriveExchange(DriveEndpoint(file, parse_address(drive.address)), period_s=0.1)
    ) as exchange:

        def reached(speed: float) -> bool:
            """Ask for a speed, and return whether both motor and driver show it."""
            exchange.request_speed(speed or None)
            status = exchange.snapshot.status
            return (
                status is not None and status.speed == pytest.approx(speed, abs=2e-3)
                and drive.speed() == pytest.approx(speed, abs=1e-3)
            )

        def fault() -> str | None:
            return exchange.snapshot.status and exchange.snapshot.status.fault

        exchange.start()
        until(lambda: reached(0.6), 8)
        assert exchange.snapshot.timeout_s == timeout
        until(lambda: reached(0.0), 8)
        until(lambda: reached(0.4), 8)
        drive.inject("drive_fault")
        until(lambda: fault() and drive.speed() == 0)
        drive.inject("none")
        exchange.request_speed(None)
        exchange.reset()
        until(lambda: fault() == "")
        exchange.close()
        alone = Drive(file, parse_address(drive.address))
        alone.line.connect()
        alone.run(0.6)
        alone.line.close()
        until(lambda: drive.speed() > 0.5)
        until(lambda: drive.speed() == 0)
    assert f"communication timeout: nothing for {timeout} s" in drive.output
