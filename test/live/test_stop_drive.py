"""``greenroof stop-drive``, as the systemd service calls it after the end of a site."""

from __future__ import annotations

from pathlib import Path

from commands import run_command
from graphs import environment, free_ports
from places import guarding
from simulators import Simulator

from greenroof_ros.live.devices.exchange import read_endpoint


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
