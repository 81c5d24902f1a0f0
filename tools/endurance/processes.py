"""The programs that a long run starts, and what a site is told of its weather."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import yaml
from graphs import Process, free_ports, wait_for
from places import CONFIG

START_S = 60.0
# Of the constant weather of a live run: mm/h, mm/day, degC.
RAIN, EVAPOTRANSPIRATION, TEMPERATURE = 0.0, 3.0, 15.0


def drive_address(program: Process) -> str:
    """Return where a drive simulator says that its drive is."""
    return program.stdout().split()[2].rstrip(",;")


@contextmanager
def simulator(domain: int, directory: Path, module: str, *options: str) -> Iterator[Process]:
    """Run a simulated drive or site."""
    process = Process(domain, module, *options, cwd=directory)
    try:
        wait_for(lambda: process.stdout().startswith("ready:"), START_S, f"{module}")
        yield process
    finally:
        process.process.send_signal(signal.SIGTERM)
        process.process.wait(15)


def simulate(directory: Path, output: str, *options: str) -> dict[str, Any]:
    """Return the summary of the pure simulation of a run, in one process."""
    process = Process(0, "simulate", "--output", output, *options, cwd=directory)
    code = process.process.wait()
    if code:
        raise RuntimeError(process.stderr())
    found: dict[str, Any] = json.loads((directory / output / "summary.json").read_text())
    return found


def write_weather(path: Path, start: datetime) -> None:
    """Write two days of the constant weather for a simulation."""
    lines = ["time,precipitation [mm/h],constant evapotranspiration [mm/day]"]
    lines += [
        f"{(start + timedelta(hours=hour)).isoformat()},{RAIN},{EVAPOTRANSPIRATION}"
        for hour in range(48)
    ]
    path.write_text("\n".join(lines) + "\n")


def write_forecast(path: Path, issued: datetime) -> None:
    """Put a forecast of six days of the constant weather in place, whole."""
    lines = ["issued,time,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"]
    lines += [
        f"{issued.isoformat()},{(issued + timedelta(hours=hour)).isoformat()},"
        f"{RAIN},{EVAPOTRANSPIRATION},{TEMPERATURE}"
        for hour in range(144)
    ]
    draft = path.with_suffix(".new")
    draft.write_text("\n".join(lines) + "\n")
    draft.replace(path)


def write_sensors(path: Path) -> None:
    """Write the sensor file of the simulated site, each sensor on a free port."""
    sensors = yaml.safe_load((CONFIG / "sensors.yaml").read_text())
    for tank, port in zip(("cistern", "roof"), free_ports(2), strict=True):
        sensors[tank]["address"] = f"tcp://127.0.0.1:{port}"
    path.write_text(yaml.safe_dump(sensors))


