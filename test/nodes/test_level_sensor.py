"""The level sensor node against the site simulator: what it publishes, and when it does not."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

rclpy = pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="sensors are on Modbus")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from graphs import environment  # noqa: E402
from places import CONFIG  # noqa: E402
from simulators import PATIENCE_S, Workbench  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402
from test_nodes import Observer, observer, qos  # noqa: E402, F401

from greenroof_ros.drives.address import parse_address  # noqa: E402
from greenroof_ros.simulators.faults import SITE_FAULTS  # noqa: E402


def inject(address: str, fault: str) -> None:
    workbench = Workbench(parse_address(address), SITE_FAULTS, PATIENCE_S)
    workbench.inject(fault)
    workbench.close()


def test_levels_of_a_simulated_site(
    domain: int, tmp_path: Path, observer: Observer  # noqa: F811
) -> None:
    """Both tanks: their levels once a period; of a bad sensor nothing, and why."""
    sensors = yaml.safe_load((CONFIG / "sensors.yaml").read_text())
    for number, tank in enumerate(("cistern", "roof")):
        sensors[tank] |= {"address": f"tcp://127.0.0.1:{15830 + domain * 2 + number}"}
        sensors[tank] |= {"period": 0.2}
    file = tmp_path / "sensors.yaml"
    file.write_text(yaml.safe_dump(sensors))
    levels: dict[str, list[float]] = {"cistern": [], "roof": []}
    statuses: dict[str, tuple[bytes, str, str]] = {}
    for tank, values in levels.items():
        observer.node.create_subscription(
            Float64, f"/{tank}/level", lambda message, to=values: to.append(message.data),
            qos(f"/{tank}/level"),
        )

    def on_diagnostics(array: DiagnosticArray) -> None:
        for one in array.status:
            statuses[one.name] = (one.level, one.message, one.hardware_id)

    observer.node.create_subscription(
        DiagnosticArray, "/diagnostics", on_diagnostics, qos("/diagnostics")
    )
    site = subprocess.Popen(
        [
            sys.executable, "-m", "greenroof_ros.site_simulator", "--sensors", str(file),
            "--workbench", "0", "--cistern", "50", "--roof", "2",
        ],
        cwd=tmp_path, env=environment(domain), stdout=subprocess.PIPE, text=True,
    )
    nodes = [
        subprocess.Popen(
            [
                sys.executable, "-m", "greenroof_ros.nodes.level_sensor", "--tank", tank,
                "--ros-args", "-p", f"sensors_file:={file}",
            ],
            cwd=tmp_path, env=environment(domain),
        )
        for tank in levels
    ]
    try:
        assert site.stdout is not None
        found = re.search(r"workbench (\S+),", site.stdout.readline())
        assert found
        observer.until(lambda: levels["cistern"] and levels["roof"], 60, "levels")
        # 50 m3 on 25 m2, 2 m3 on 68.8 m2, of which a dry night takes next to nothing.
        assert levels["cistern"][-1] == pytest.approx(2.0, abs=2e-3)
        assert levels["roof"][-1] == pytest.approx(2 / 68.8, abs=1e-3)
        began = time.monotonic()
        observer.until(lambda: time.monotonic() > began + 0.5, 60, "what was published before")
        began, before = time.monotonic(), len(levels["roof"])
        observer.until(lambda: len(levels["roof"]) >= before + 30, 60, "30 levels")
        assert time.monotonic() - began > 2.5  # 6 s, but for what may have waited
        for fault in ("roof_silent", "roof_absurd"):
            inject(found[1], fault)
            observer.until(
                lambda: statuses.get("/roof_sensor: sensor", (b"",))[0] == b"\x02", 60, fault
            )
            before, other = len(levels["roof"]), len(levels["cistern"])
            observer.until(lambda: len(levels["cistern"]) > other + 3, 60, "the other's levels")  # noqa: B023
            assert len(levels["roof"]) == before
            assert sensors["roof"]["address"] in statuses["/roof_sensor: sensor"][2]
            inject(found[1], "none")
            observer.until(lambda: len(levels["roof"]) > before, 60, "a level again")  # noqa: B023
        observer.until(lambda: statuses["/roof_sensor: sensor"][0] == b"\x00", 60, "all is well")
    finally:
        for process in (*nodes, site):
            process.terminate()
        codes = [process.wait(300) for process in nodes]
        site.wait(300)
    assert codes == [0, 0]


def test_a_sensor_that_is_too_slow_for_its_readers_is_refused(domain: int, tmp_path: Path) -> None:
    """A level counts for 5 s (level_limit), and two readings must fit into that."""
    head, roof = (CONFIG / "sensors.yaml").read_text().split("roof:")
    file = tmp_path / "sensors.yaml"
    file.write_text(head + "roof:" + roof.replace("period: 1.0", "period: 2.6"))
    done = subprocess.run(
        [
            sys.executable, "-m", "greenroof_ros.nodes.level_sensor", "--tank", "roof",
            "--ros-args", "-p", f"sensors_file:={file}",
        ],
        cwd=tmp_path, env=environment(domain), capture_output=True, text=True, timeout=60,
    )
    assert done.returncode == 2
    assert f"{file}, line 36: roof.period = 2.6: must be at most 2.5 s, half of" in done.stderr
    assert "Traceback" not in done.stderr
