"""Hardware in the loop beside the pure simulation: the volume, and the deviation that follows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from endurance.processes import drive_address, free_ports, simulate, simulator
from graphs import Process

from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import read_site
from greenroof_ros.pumping.limits import Pulses, PumpSettings, pump_parameters

_SHARE = 0.01


def in_the_loop(
    directory: Path, domain: int, controller: str, hours: float, speed: float, drive: str,
    line: str,
) -> str:
    """Run a site with a simulated drive, and the same without one.

    Args:
        directory: of what the runs leave.
        domain: a ROS domain of its own.
        controller: its name.
        hours: length (simulated).
        speed: simulated per real time; the drive is that much faster, too.
        drive: a name of config/drives.
        line: ``tcp``, or ``pty`` for Modbus RTU over a pseudo-terminal.

    Returns:
        A row of the table.
    """
    port, bench = free_ports(2)
    where = ("--port", str(port)) if line == "tcp" else ("--serial", "pty")
    options = ("--controller", controller, "--hours", str(hours))
    with simulator(
        domain, directory, "drive_simulator", "--drive", drive, "--speed", str(speed), *where,
        "--workbench", str(bench),
    ) as program:
        run = Process(
            domain, "bringup", *options, "--speed", str(speed), "--drive", drive,
            "--drive-at", drive_address(program),
            "--state", str(directory / "state"), "--output", "run", cwd=directory,
        )
        code = run.process.wait()
    if code:
        raise RuntimeError(f"exit code {code}: {run.stderr()}")
    loop: dict[str, Any] = json.loads((directory / "run" / "summary.json").read_text())
    pure = simulate(directory, "pure", *options)
    site = read_site(Path(loop["site"]))
    settings = PumpSettings(**{one.name: one.default for one in pump_parameters(site)})
    level = Plant(site, pure["final_cistern_m3"], 0.0).levels()[0]
    pulse = Pulses(site, settings).least_pulse(level)
    pumped, wanted = loop["pumped_m3"], pure["pumped_m3"]
    allowed = max(_SHARE * wanted, pulse)
    verdict = "within" if abs(pumped - wanted) <= allowed else "NOT within"
    return (
        f"| {controller} | {drive}, {line} | {hours * 60:g} min at {speed:g}x | {pumped:.4f} "
        f"| {wanted:.4f} | {pumped - wanted:+.4f}, {verdict} {allowed:.4f} "
        f"| {loop['total_deviation_m3']:.1f} | {pure['total_deviation_m3']:.1f} |"
    )


HEAD = (
    "| controller | drive | length | pumped (m3) | simulated (m3) | difference (m3) "
    "| deviation (m3) | simulated (m3) |\n|---|---|---|---|---|---|---|---|"
)
