"""Hardware in the loop compared with the pure simulation: volume and resulting deviation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from faults.rig import Simulator
from graphs import Process, free_ports, summary_of
from markdown_tables import head, row

from greenroof_ros.live.pumping.limits import Pulses, PumpSettings, pump_parameters
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.site import read_site

HEAD = head([
    "controller", "drive", "length", "pumped (m3)", "simulated (m3)", "difference (m3)",
    "deviation (m3)", "simulated (m3)",
])
_SHARE = 0.01


def in_the_loop(
    directory: Path, domain: int, controller: str, hours: float, speed: float, drive: str,
    line: str,
) -> str:
    """Run a site with a simulated drive, and the same site without one.

    Args:
        directory: for the files of the runs.
        domain: a ROS domain used by nothing else.
        controller: its name.
        hours: simulated length.
        speed: simulated per real time; the drive is as much faster.
        drive: a name in config/drives.
        line: ``tcp``, or ``pty`` for Modbus RTU over a pseudo-terminal.

    Returns:
        A row of the table.
    """
    port, bench = free_ports(2)
    where = ("--port", str(port)) if line == "tcp" else ("--serial", "pty")
    options = ("--controller", controller, "--hours", str(hours))
    simulator = Simulator(
        domain, directory, "drive_simulator", "--drive", drive, "--speed", str(speed), *where,
        "--workbench", str(bench),
    )
    try:
        loop = run_to_its_end(
            domain, directory, "bringup", "run", *options, "--speed", str(speed), "--drive", drive,
            "--drive-at", simulator.place, "--state", str(directory / "state"),
        )
    finally:
        simulator.end()
    pure = run_to_its_end(0, directory, "simulate", "pure", *options)
    site = read_site(Path(loop["site"]))
    settings = PumpSettings(**{setting.name: setting.default for setting in pump_parameters(site)})
    level = Plant(site, pure["final_cistern_m3"], 0.0).levels()[0]
    pumped, wanted = loop["pumped_m3"], pure["pumped_m3"]
    allowed = max(_SHARE * wanted, Pulses(site, settings).least_pulse(level))
    verdict = "within" if abs(pumped - wanted) <= allowed else "NOT within"
    return row([
        controller, f"{drive}, {line}", f"{hours * 60:g} min at {speed:g}x", f"{pumped:.4f}",
        f"{wanted:.4f}", f"{pumped - wanted:+.4f}, {verdict} {allowed:.4f}",
        f"{loop['total_deviation_m3']:.1f}", f"{pure['total_deviation_m3']:.1f}",
    ])


def run_to_its_end(
    domain: int, directory: Path, module: str, output: str, *options: str
) -> dict[str, Any]:
    """Run a simulation, with or without a graph, and return its summary."""
    process = Process(domain, module, "--output", output, *options, cwd=directory)
    if code := process.process.wait():
        raise RuntimeError(f"exit code {code}: {process.stderr()}")
    return summary_of(directory / output)
