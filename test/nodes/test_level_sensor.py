"""The level sensor node against the site simulator: what it publishes, and when it does not."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest
import yaml
from graphs import Process, free_ports, wait_for
from places import CONFIG
from ros_rig import ERROR, OK, Observer
from simulators import PATIENCE_S, Workbench

from greenroof_ros.drives.modbus_line import parse_address
from greenroof_ros.simulators.faults import SITE_FAULTS


def inject(address: str, fault: str) -> None:
    workbench = Workbench(parse_address(address), SITE_FAULTS, PATIENCE_S)
    workbench.inject(fault)
    workbench.close()


def test_levels_of_a_simulated_site(domain: int, tmp_path: Path, observer: Observer) -> None:
    """Both tanks: their levels once a period; of a bad sensor nothing, and why."""
    sensors = yaml.safe_load((CONFIG / "sensors.yaml").read_text())
    for tank, port in zip(("cistern", "roof"), free_ports(2), strict=True):
        sensors[tank] |= {"address": f"tcp://127.0.0.1:{port}", "period": 0.2}
    file = tmp_path / "sensors.yaml"
    file.write_text(yaml.safe_dump(sensors))
    levels = {tank: observer.hear(f"/{tank}/level") for tank in ("cistern", "roof")}
    site = Process(
        domain, "site_simulator", "--sensors", str(file), "--workbench", "0", "--cistern", "50",
        "--roof", "2", cwd=tmp_path,
    )
    found = wait_for(lambda: re.search(r"workbench (\S+),", site.stdout()), 60, "the workbench")
    nodes = [observer.start(f"level_sensor --tank {tank}", sensors_file=file) for tank in levels]
    observer.until(lambda: levels["cistern"] and levels["roof"], 60, "levels")
    # 50 m3 on 25 m2, 2 m3 on 68.8 m2, of which a dry night takes next to nothing.
    assert levels["cistern"][-1] == pytest.approx(2.0, abs=2e-3)
    assert levels["roof"][-1] == pytest.approx(2 / 68.8, abs=1e-3)
    began, before = time.monotonic(), len(levels["roof"])
    observer.until(lambda: len(levels["roof"]) >= before + 20, 60, "20 levels")
    assert time.monotonic() - began > 2  # 4 s, but for what may have waited
    part = "/roof_sensor: sensor"
    inject(found[1], "roof_absurd")
    observer.until(observer.says(part, ERROR), 60, "what is wrong")
    for _ in range(2):  # at first what was published before may come
        before, other = len(levels["roof"]), len(levels["cistern"])
        observer.until(lambda: len(levels["cistern"]) > other + 3, 60, "the other's levels")  # noqa: B023
    assert len(levels["roof"]) == before
    assert sensors["roof"]["address"] in observer.diagnoses[part].hardware_id
    inject(found[1], "none")
    observer.until(lambda: len(levels["roof"]) > before, 60, "a level again")
    observer.until(observer.says(part, OK), 60, "all is well")
    for node in nodes:
        node.terminate()
        assert node.wait(300) == 0
