"""The simulated drive, by the driver and ``greenroof stop-drive``; the simulated valve.

The driver shows how each make obeys; test_wire.py checks the driver's words against the manuals.
The valve's relay, sensors and flows are shown by the fault campaign.
"""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment, free_ports
from places import guarding
from simulators import Simulator, until

from greenroof_ros.live.devices.drive import Drive, DriveEndpoint
from greenroof_ros.live.devices.drive_file import read_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint
from greenroof_ros.live.devices.modbus_line import parse_address
from greenroof_ros.live.simulators.relay import SimulatedValve


@pytest.mark.parametrize(
    "make", ["abb_acs880", "danfoss_fc202", "grundfos_cim500", "schneider_atv630"]
)
def test_with_the_driver_every_make_runs_and_stops_also_by_its_own_timeout(
    make: str, tmp_path: Path
) -> None:
    """The timeout of a CIM is fixed."""
    timeout = 5 if make == "grundfos_cim500" else 2
    file = read_drive_file(Path(guarding(make, tmp_path)))
    with Simulator(
        "drive_simulator", "--drive", make, "--port", "0", "--ramp", "0.4", "--timeout", "2"
    ) as drive, closing(
        DriveExchange(DriveEndpoint(file, parse_address(drive.address)))
    ) as exchange:

        def reached(speed: float) -> bool:
            """Ask for a speed, and return whether both motor and driver show it."""
            exchange.request_speed(speed or None)
            status = exchange.snapshot.status
            shown = (status.speed if status else -1.0), drive.speed()
            return shown == (pytest.approx(speed, abs=2e-3), pytest.approx(speed, abs=1e-3))

        exchange.start()
        for speed in (0.6, 0.0, 0.4):
            until(lambda speed=speed: reached(speed), 8)  # type: ignore[misc]
        assert exchange.snapshot.timeout_s == timeout
        exchange.close()
        alone = Drive(file, parse_address(drive.address))
        alone.line.connect()
        alone.run(0.6)
        alone.line.close()
        until(lambda: drive.speed() > 0.5)
        until(lambda: drive.speed() == 0)
    assert f"communication timeout: silence for {timeout} s" in drive.output


def test_a_mistake_in_a_trial_is_found_before_its_devices_start(tmp_path: Path) -> None:
    """In one line, without a traceback."""
    ended = run_command("simulators live", "--forecast", "f.txt", cwd=tmp_path,
                        env=environment(0))
    assert (ended.returncode, "process" in ended.stdout) == (2, False)
    assert "must be a FILE.csv" in ended.stderr and ended.stderr.count("\n") == 1


def test_a_drive_whose_program_has_died_is_stopped(tmp_path: Path) -> None:
    file = guarding("abb_acs880", tmp_path)
    command = "stop-drive", "--drive", file, "--drive-at"
    with Simulator("drive_simulator", "--drive", file, "--port", "0", "--workbench", "0") as bench:
        drive = read_endpoint(Path(file), bench.address, "").connection()
        drive.line.connect()
        drive.read()
        drive.run(1.0)
        drive.line.close()
        stopped = run_command(*command, bench.address, cwd=tmp_path, env=environment(0))
        assert stopped.returncode == 0 and bench.speed() <= 0.02  # a standstill
    (nobody,) = free_ports(1)
    lost = run_command(*command, f"tcp://127.0.0.1:{nobody}", cwd=tmp_path, env=environment(0))
    assert (lost.returncode, lost.stdout[:23]) == (1, "THE PUMP MAY BE RUNNING")


_OPEN, _CLOSED, _WRONG = (1, 0), (0, 1), (1, 1)


@pytest.mark.parametrize(("fault", "on", "off"), [
    ("", _OPEN, _CLOSED), ("leak", _OPEN, _CLOSED), ("wrong_switch", _OPEN, _WRONG),
    ("stuck_open", _OPEN, _OPEN), ("stuck_closed", _CLOSED, _CLOSED),
])
def test_it_follows_its_relay_within_its_travel_time_unless_it_is_stuck(
    monkeypatch: pytest.MonkeyPatch, fault: str, on: tuple[int, int], off: tuple[int, int]
) -> None:
    """Shown by the switches for open and for closed."""
    now, relay = 0.0, False
    monkeypatch.setattr(time, "monotonic", lambda: now)
    valve = SimulatedValve(lambda: relay, 30.0, fault)
    for relay, expected in ((True, on), (False, off)):  # noqa: B007
        now += 15.0
        assert fault or valve.advance() == pytest.approx(0.5)
        now += 15.1
        valve.advance()
        assert (*valve.switches().values(),) == expected
