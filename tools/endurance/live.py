"""A live site for an hour: nodes killed, controllers changed, a disk that is full for a while."""

from __future__ import annotations

import csv
import json
import os
import signal
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, timezone
from itertools import cycle
from pathlib import Path
from typing import Any

from disks import disk_if_allowed
from endurance.figures import Figures
from endurance.processes import (
    EVAPOTRANSPIRATION,
    RAIN,
    START_S,
    drive_address,
    free_ports,
    simulate,
    simulator,
    write_forecast,
    write_sensors,
    write_weather,
)
from graphs import Process, wait_for
from places import CONFIG
from rich.progress import Progress

from greenroof_ros.drives.sensor_file import QUANTITIES
from greenroof_ros.model.site import Site, read_site

_SAMPLE_S = 15.0
_NODES = ("cistern_sensor", "controller", "pump", "weather", "recorder", "roof_sensor")
# The bag's disk (MB), and for which part of the run it is full.
_DISK_MB, _FULL_FROM, _FULL_TO = 64, 0.45, 0.52


@dataclass(frozen=True)
class Plan:
    """What is done to a live site.

    Attributes:
        minutes: how long it runs.
        controllers: one after the other, each for an equal part.
        kill_every: a node is killed so often (s); 0 for never.
        full_disk: the disk of the bag is full for a while.
        drive: a name of config/drives.
    """

    minutes: float
    controllers: tuple[str, ...]
    kill_every: float
    full_disk: bool
    drive: str


class LiveRun:
    """A live site with simulated sensors and drive, each a program of its own."""

    def __init__(self, directory: Path, domain: int, plan: Plan, stack: ExitStack) -> None:
        self.directory, self.domain, self.plan = directory, domain, plan
        drive, bench, site_bench = free_ports(3)
        write_sensors(directory / "sensors.yaml")
        write_forecast(directory / "forecast.csv", _hour())
        self._disk = directory / "state"
        mounted = plan.full_disk and stack.enter_context(disk_if_allowed(
            self._disk, f"{_DISK_MB}m"
        ))
        self.disk_note = "" if mounted or not plan.full_disk else "no small disk could be mounted"
        self._mounted = bool(mounted)
        self.programs = {
            "drive_simulator": stack.enter_context(simulator(
                domain, directory, "drive_simulator", "--drive", plan.drive, "--port", str(drive),
                "--workbench", str(bench),
            )),
            "site_simulator": stack.enter_context(simulator(
                domain, directory, "site_simulator", "--sensors", "sensors.yaml", "--drive-at",
                f"tcp://127.0.0.1:{bench}", "--workbench", str(site_bench),
                "--rain", str(RAIN), "--constant-evapotranspiration", str(EVAPOTRANSPIRATION),
                "--output", "levels.csv",
            )),
        }
        self._drive_at = drive_address(self.programs["drive_simulator"])
        self.figures = Figures()
        self.killed: list[str] = []
        self.incidents: list[dict[str, Any]] = []
        self.bad_ends: list[str] = []
        # Controller, first tick, last tick.
        self.parts: list[tuple[str, int, int]] = []

    def run(self) -> None:
        """Run each controller for its part."""
        seconds = 60 * self.plan.minutes
        began = time.monotonic()
        kills = cycle(_NODES)
        next_kill = began + self.plan.kill_every if self.plan.kill_every else float("inf")
        next_sample = began + _SAMPLE_S
        full = False
        with Progress() as progress:
            bar = progress.add_task("live", total=seconds)
            for number, controller in enumerate(self.plan.controllers, 1):
                ends = began + seconds * number / len(self.plan.controllers)
                bringup = self._bring_up(controller)
                first = self._tick()
                while time.monotonic() < ends:
                    now = time.monotonic()
                    passed = (now - began) / seconds
                    progress.update(bar, completed=now - began)
                    if bringup.process.poll() is not None:
                        raise RuntimeError(f"bringup ended: {bringup.stderr()[-2000:]}")
                    if now >= next_sample:
                        next_sample += _SAMPLE_S
                        write_forecast(self.directory / "forecast.csv", _hour())
                        self.figures.sample(self._pids(bringup))
                    if now >= next_kill and ends - now > 20:
                        next_kill += self.plan.kill_every
                        name = next(kills)
                        pid = _nodes(bringup.process.pid).get(name)
                        if pid is not None:
                            os.kill(pid, signal.SIGKILL)
                            self.killed.append(name)
                    if self._mounted and not full and _FULL_FROM < passed < _FULL_TO:
                        full = True
                        self._fill()
                    if full and passed >= _FULL_TO:
                        full = False
                        (self._disk / "filling").unlink()
                    time.sleep(0.2)
                self._end(bringup, controller)
                self.parts.append((controller, first, self._tick()))

    def _bring_up(self, controller: str) -> Process:
        bringup = Process(
            self.domain, "bringup.live", "--controller", controller,
            "--sensors", "sensors.yaml", "--forecast", "forecast.csv", "--drive", self.plan.drive,
            "--drive-at", self._drive_at, "--state", "state", "--restarts", "1000",
            cwd=self.directory,
        )
        wait_for(lambda: "all nodes are here" in bringup.stderr(), START_S, "all nodes")
        return bringup

    def _end(self, bringup: Process, controller: str) -> None:
        bringup.process.terminate()
        code = bringup.process.wait(60)
        if code not in (0, 1) or "Traceback" in bringup.stderr():  # 1: there were incidents
            self.bad_ends.append(f"{controller}: exit code {code}: {bringup.stderr()[-500:]}")
        summary = json.loads((self._disk / "summary.json").read_text())
        self.incidents += summary["incidents"]

    def _fill(self) -> None:
        with (self._disk / "filling").open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(1 << 16))
            except OSError:
                pass
            try:
                while True:
                    file.write(b"\0")
            except OSError:
                return

    def _pids(self, bringup: Process) -> dict[str, int]:
        pid = bringup.process.pid
        programs = {name: one.process.pid for name, one in self.programs.items()}
        return {"bringup": pid, **_nodes(pid), **programs}

    def _tick(self) -> int:
        return len((self.directory / "levels.csv").read_text().splitlines()) - 2

    # --- what came of it ------------------------------------------------------------------------

    def report(self) -> str:
        """Return what came of it, in Markdown."""
        site = read_site(CONFIG / "site.yaml")
        with (self.directory / "levels.csv").open() as stream:
            rows = list(csv.DictReader(stream))
        start = datetime(2024, 6, 1, tzinfo=timezone.utc)
        write_weather(self.directory / "weather.csv", start)
        lines = [
            "| controller | min | pumped (m3) | simulated (m3) | deviation (m3) "
            "| simulated (m3) |", "|---|---|---|---|---|---|",
        ]
        totals = [0.0] * 4
        for number, (controller, first, last) in enumerate(self.parts):
            begin, end = rows[first], rows[last]
            pure = simulate(
                self.directory, f"pure-{number}", "--controller", controller, "--weather",
                "weather.csv", "--start", start.isoformat(), "--hours",
                str((last - first) * site.tau / 3600), "--cistern",
                str(float(begin["cistern_level_m"]) * site.a1), "--roof", _roof(begin, site),
            )
            live = (
                float(end["pumped_m3"]) - float(begin["pumped_m3"]), pure["pumped_m3"],
                sum(
                    abs(float(row["roof_level_m"]) * site.a2 - site.x2_star)
                    for row in rows[first : last + 1]
                ), pure["total_deviation_m3"],
            )
            totals = [total + one for total, one in zip(totals, live, strict=True)]
            lines.append(_row(controller, (last - first) * site.tau / 60, live))
        lines.append(_row("together", sum(b - a for _, a, b in self.parts) * site.tau / 60, totals))
        causes = [f"{one['node']}: {one['cause']}" for one in self.incidents]
        lines += [
            "", f"Killed: {len(self.killed)}. Incidents: {len(causes)}.", "",
            *(f"- {causes.count(cause)} times {cause}" for cause in sorted(set(causes))),
            "", *filter(None, [self.disk_note]), *self.bad_ends, "", self.figures.table(),
        ]
        return "\n".join(lines)


def _roof(row: dict[str, str], site: Site) -> str:
    return str(float(row["roof_level_m"]) * site.a2)


def _row(name: str, minutes: float, values: tuple[float, ...] | list[float]) -> str:
    pumped, pure, deviation, pure_deviation = values
    return (
        f"| {name} | {minutes:.1f} | {pumped:.4f} | {pure:.4f} | {deviation:.1f} "
        f"| {pure_deviation:.1f} |"
    )


def _hour() -> datetime:
    return datetime.now(timezone.utc).replace(minute=0, second=0, microsecond=0)


def _nodes(bringup: int) -> dict[str, int]:
    """Return the process of each node, by what it is."""
    found = {}
    try:
        children = Path(f"/proc/{bringup}/task/{bringup}/children").read_text().split()
    except OSError:
        return {}
    for pid in children:
        try:
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        except OSError:
            continue
        module = next((word for word in words if word.startswith("greenroof_ros.nodes.")), None)
        if module is None:
            continue
        name = module.rpartition(".")[2].removeprefix("live_")
        if name == "sensor":
            name = QUANTITIES[words[words.index("--of") + 1]].node
        found[name] = int(pid)
    return found
