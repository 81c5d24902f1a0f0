"""A live site by bringup, with a simulated drive, tanks and level sensors."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

from graphs import Process, alive, free_ports, wait_for
from places import CONFIG, guarding
from ros_rig import write_forecast
from simulators import Simulator

QUICK = "/**:\n  ros__parameters:\n    recovery_time: 1.0\n"


@contextmanager
def live(
    domain: int, cwd: Path, *arguments: str, code: int = 0, stderr: int | None = None
) -> Iterator[Process]:
    """Bring up a site; on request it must end as expected, together with all of its nodes."""
    process = Process(domain, "bringup.live", "--state", "run", *arguments, cwd=cwd, stderr=stderr)
    yield process
    nodes = process.nodes().values()
    process.process.send_signal(signal.SIGTERM)
    assert process.wait(300) == code, process.stderr()
    assert not any(map(alive, nodes))
    assert "Traceback" not in process.stderr()


class Hardware(Simulator):
    """A drive and, on request, tanks with level sensors, simulated by programs."""

    def __init__(self, domain: int, cwd: Path) -> None:
        super().__init__(
            "drive_simulator", "--drive", "abb_acs880", "--ramp", "1", "--port", "0",
            "--workbench", "0",
        )
        self.domain, self.cwd, self.file = domain, cwd, guarding("abb_acs880", cwd)

    def be_a_site(self) -> tuple[str, ...]:
        """Return bringup's options for a site without sensors and with an old forecast."""
        cistern, roof = free_ports(2)
        text = (CONFIG / "sensors.yaml").read_text()
        (self.cwd / "sensors.yaml").write_text(
            text.replace(":5030", f":{cistern}").replace(":5031", f":{roof}")
            .replace("period: 1.0", "period: 0.5")
        )
        write_forecast(self.cwd / "forecast.csv", timedelta(days=2000), 0.0, 12.0)
        (self.cwd / "nodes.yaml").write_text(f"{QUICK}    min_off: 1.0\n")
        return (
            "--controller", "onoff", "--sensors", "sensors.yaml", "--forecast", "forecast.csv",
            "--drive", self.file, "--drive-at", self.address, "--node-parameters", "nodes.yaml",
        )

    def begin(self) -> None:
        """Fill the tanks, start the sensors, and write a forecast."""
        tanks = Process(
            self.domain, "site_simulator", "--sensors", "sensors.yaml", "--drive-at",
            self.workbench, "--workbench", "0", "--initial", "high-low", cwd=self.cwd,
        )
        wait_for(tanks.stdout, 60, "sensors that are ready")
        write_forecast(self.cwd / "forecast.csv", timedelta(minutes=5), 0.0, 12.0)

    def speed(self) -> float:
        """Return the pump's true speed (share of rated); each call takes 0.1 s."""
        time.sleep(0.1)
        return super().speed()

    def until_it_pumps(self) -> None:
        wait_for(lambda: self.speed() > 0.9, 90, "the pump")
