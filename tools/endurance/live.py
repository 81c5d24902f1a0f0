"""A live site for an hour: nodes are killed, controllers changed, a disk is full for a while."""

from __future__ import annotations

import csv
import os
import signal
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import datetime, timedelta, timezone
from itertools import cycle
from pathlib import Path
from typing import Any

import yaml
from disks import disk_if_allowed, fill
from endurance.figures import Figures
from endurance.loop import run_to_its_end
from faults.rig import Simulator
from graphs import Process, free_ports, summary_of
from markdown_tables import head, row
from places import CONFIG
from rich.progress import Progress
from ros_rig import write_forecast

from greenroof_ros.model.site import read_site

# Constant weather: mm/h, mm/day.
_RAIN, _EVAPOTRANSPIRATION = 0.0, 3.0
_START_S, _SAMPLE_S = 60.0, 15.0
_NODES = ("sensors", "controller", "pump", "weather", "recorder")
# Size of the bag's disk (MB), and the part of the run during which it is full (1).
_DISK_MB, _FULL_FROM, _FULL_TO = 64, 0.45, 0.52


class LiveRun(ExitStack):
    """A live site with simulated sensors and drive, each in its own process."""

    def __init__(self, directory: Path, domain: int, drive: str, *, full_disk: bool) -> None:
        """Start the programs.

        Args:
            directory: for the files of the run.
            domain: a ROS domain used by nothing else.
            drive: a name in config/drives.
            full_disk: whether the bag's disk is full for a while.
        """
        super().__init__()
        self._directory, self._domain, self._drive_file = directory, domain, drive
        self._state = directory / "state"
        self._mounted = full_disk and self.enter_context(
            disk_if_allowed(self._state, f"{_DISK_MB}m"))
        self._notes = ["no small disk could be mounted"] if full_disk > self._mounted else []
        *sensor_ports, port, bench, site_bench = map(str, free_ports(5))
        sensors = yaml.safe_load((CONFIG / "sensors.yaml").read_text())
        for tank, sensor_port in zip(("cistern", "roof"), sensor_ports, strict=True):
            sensors[tank]["address"] = f"tcp://127.0.0.1:{sensor_port}"
        (directory / "sensors.yaml").write_text(yaml.safe_dump(sensors))
        self._drive = self._start(
            "drive_simulator", "--drive", drive, "--port", port, "--workbench", bench
        )
        self._site = self._start(
            "site_simulator", "--sensors", "sensors.yaml", "--drive-at", f"tcp://127.0.0.1:{bench}",
            "--workbench", site_bench, "--rain", str(_RAIN), "--constant-evapotranspiration",
            str(_EVAPOTRANSPIRATION), "--output", "levels.csv",
        )
        self._figures = Figures()
        self._killed = 0
        self._incidents: list[dict[str, Any]] = []
        # Controller, first tick, last tick.
        self._parts: list[tuple[str, int, int]] = []

    def _start(self, module: str, *options: str) -> Simulator:
        simulator = Simulator(self._domain, self._directory, module, *options)
        self.callback(simulator.end)
        return simulator

    def run(self, minutes: float, controllers: Sequence[str], kill_every: float) -> None:
        """Run the controllers one after the other, each for an equal part.

        Args:
            minutes: total length.
            controllers: their names.
            kill_every: time between two kills of a node (s).
        """
        began = next_sample = time.monotonic()
        next_kill = began + kill_every
        kills = cycle(_NODES)
        with Progress() as progress:
            bar = progress.add_task("live", total=60 * minutes)
            for number, controller in enumerate(controllers, 1):
                ends = began + 60 * minutes * number / len(controllers)
                bringup = self._bring_up(controller)
                first = self._tick()
                while (now := time.monotonic()) < ends:
                    progress.update(bar, completed=now - began)
                    assert bringup.process.poll() is None, bringup.stderr()[-2000:]
                    if now >= next_sample:
                        next_sample += _SAMPLE_S
                        self._forecast()
                        self._figures.sample({
                            "bringup": bringup.process.pid, **bringup.nodes(),
                            "drive_simulator": self._drive.process.process.pid,
                            "site_simulator": self._site.process.process.pid,
                        })
                    if now >= next_kill and ends - now > 20:
                        next_kill += kill_every
                        if pid := bringup.nodes().get(next(kills)):
                            os.kill(pid, signal.SIGKILL)
                            self._killed += 1
                    self._fill((now - began) / (60 * minutes))
                    time.sleep(0.2)
                self._end(bringup, controller)
                self._parts.append((controller, first, self._tick()))

    def _forecast(self) -> None:
        past_the_hour = timedelta(seconds=time.time() % 3600)
        write_forecast(
            self._directory / "forecast.csv", past_the_hour, _RAIN, hours=144,
            evapotranspiration=_EVAPOTRANSPIRATION,
        )

    def _bring_up(self, controller: str) -> Process:
        self._forecast()
        bringup = Process(
            self._domain, "bringup.live", "--controller", controller,
            "--sensors", "sensors.yaml", "--forecast", "forecast.csv", "--drive", self._drive_file,
            "--drive-at", self._drive.place, "--state", "state", "--restarts", "1000",
            cwd=self._directory,
        )
        bringup.until_printed("all nodes are here", _START_S)
        return bringup

    def _fill(self, passed: float) -> None:
        """Fill the disk, or free it, as the part of the run requires."""
        filling = self._state / "filling"
        if not self._mounted or (_FULL_FROM < passed < _FULL_TO) == filling.exists():
            return
        if filling.exists():
            filling.unlink()
        else:
            fill(filling)

    def _end(self, bringup: Process, controller: str) -> None:
        bringup.process.terminate()
        code = bringup.process.wait(60)
        if code != 0 or "Traceback" in bringup.stderr():
            self._notes.append(f"{controller}: exit code {code}: {bringup.stderr()[-500:]}")
        self._incidents += summary_of(self._state)["incidents"]

    def _tick(self) -> int:
        return len((self._directory / "levels.csv").read_text().splitlines()) - 2

    # --- what came of it ------------------------------------------------------------------------

    def report(self) -> str:
        """Return the results in Markdown."""
        with (self._directory / "levels.csv").open() as stream:
            ticks = list(csv.DictReader(stream))
        lines = [head([
            "controller", "min", "pumped (m3)", "simulated (m3)", "deviation (m3)",
            "simulated (m3)",
        ])]
        parts = [
            (controller, *self._with_simulation(controller, ticks[first : last + 1]))
            for controller, first, last in self._parts
        ]
        _, *numbers = zip(*parts, strict=True)
        for name, minutes, pumped, pure, deviation, pure_deviation in (
            *parts, ("together", *map(sum, numbers)),
        ):
            lines.append(row([
                name, f"{minutes:.1f}", f"{pumped:.4f}", f"{pure:.4f}", f"{deviation:.1f}",
                f"{pure_deviation:.1f}",
            ]))
        causes = Counter(f"{incident['node']}: {incident['cause']}" for incident in self._incidents)
        return "\n".join([
            *lines, "", f"Killed: {self._killed}. Incidents: {causes.total()}.", "",
            *(f"- {count} times {cause}" for cause, count in sorted(causes.items())),
            "", *self._notes, "", self._figures.table(),
        ])

    def _with_simulation(
        self, controller: str, ticks: Sequence[dict[str, str]]
    ) -> tuple[float, ...]:
        """Return a part's minutes, volume (m3) and deviation (m3), both with the simulation's.

        The simulation starts from the live site's state, with the same weather.
        """
        site = read_site(CONFIG / "site.yaml")
        start = datetime(2024, 6, 1, tzinfo=timezone.utc)
        weather = self._directory / "weather.csv"
        weather.write_text("\n".join([
            "time,precipitation [mm/h],constant evapotranspiration [mm/day]",
            *(f"{(start + timedelta(hours=hour)).isoformat()},{_RAIN},{_EVAPOTRANSPIRATION}"
              for hour in range(48)), "",
        ]))
        begin, end, seconds = ticks[0], ticks[-1], (len(ticks) - 1) * site.tau
        pure = run_to_its_end(
            0, self._directory, "simulate", f"pure-{begin['time_s']}", "--controller",
            controller, "--weather", str(weather), "--start", start.isoformat(), "--hours",
            str(seconds / 3600), "--cistern", str(float(begin["cistern_level_m"]) * site.a1),
            "--roof", str(float(begin["roof_level_m"]) * site.a2),
        )
        deviation = sum(
            abs(float(tick["roof_level_m"]) * site.a2 - site.x2_star) for tick in ticks
        )
        return (
            seconds / 60, float(end["pumped_m3"]) - float(begin["pumped_m3"]), pure["pumped_m3"],
            deviation, pure["total_deviation_m3"],
        )
