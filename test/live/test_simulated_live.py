"""A live site on simulated devices, in one command."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import Process, alive, environment, summary_of, wait_for
from places import CONFIG


@pytest.mark.graph
def test_a_new_site_is_watered_within_a_minute(domain: int, tmp_path: Path) -> None:
    """Neither a broker nor a forecast is needed, and Ctrl-C leaves no process behind."""
    shutil.copy(CONFIG / "site.yaml", tmp_path / "my_site.yaml")
    site = Process(
        domain, "simulators live", "--site", "my_site.yaml", "--state", "run", cwd=tmp_path
    )
    site.until_printed("running:", 90)
    devices = int(site.stdout().split("process ")[1].split()[0])

    def pumps() -> bool:
        status = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status"], env=environment(domain),
            capture_output=True, text=True, check=False,
        )
        return "pump: running" in status.stdout

    wait_for(pumps, 60, "the watering")
    site.process.send_signal(signal.SIGINT)
    assert site.wait(60) == 0, site.stderr()
    assert not alive(devices)
    summary = summary_of(tmp_path / "run")
    assert (summary["status"], summary["alarms"]) == ("done", [])


