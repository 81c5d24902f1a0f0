"""A sample of the campaign of seeded faults; ``make faults`` runs all of it.

It is also the test of what nodes and bringup do when processes die, hang, or are ended.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from brokers import needs_mosquitto
from graphs import environment
from places import CHECKOUT

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")

Sample = Mapping[str, tuple[tuple[str, str] | None, str]]

CAMPAIGN = CHECKOUT / "tools" / "faults" / "campaign.py"
# Each fault with the cause that must be shown, and with what must follow.
SITE: Sample = {f"site:danfoss_fc202/{fault}": outcome for fault, outcome in {
    "kill/pump": (("pump", "node_silent"), "ran again"),
    "stop long/bringup": (None, "ran again"),
    # Only the drive's own timeout can stop the pump.
    "kill both/pump and bringup": (None, "ended"),
    "drive/refused": (("pump: drive", "drive_lost"), "ran again"),
    "state file/moved away": (("pump: pump", "state_unknown"), "ran again after ~/reset"),
    "intruder/pump.flow": (("pump: flow", "two_pumps"), "ran again"),
}.items()}
MQTT: Sample = {
    "mqtt:danfoss_fc202/broker/killed": (("cistern_sensor: sensor", "broker_lost"), "ran again"),
    "relay:tasmota/broker/killed": (("pump: drive", "drive_lost"), "ran again"),
}


@pytest.mark.parametrize(
    "sample", [SITE, pytest.param(MQTT, marks=needs_mosquitto)], ids=["site", "mqtt"]
)
def test_a_sample_of_the_campaign(domain: int, tmp_path: Path, sample: Sample) -> None:
    """Each fault stops the pump and is named; then follows what is specified.

    Next to the other tests a process can be late by seconds; the campaign itself shows the bounds.
    """
    outside = {key: value for key, value in environment(domain).items()
               if not key.startswith("PYTEST_")}
    done = subprocess.run(
        [
            sys.executable, "-m", "pytest", *(f"{CAMPAIGN}::test_case[{case}]" for case in sample),
            "-q", "-p", "no:cacheprovider",
        ],
        env={**outside, "FAULTS_RESULTS": str(tmp_path), "FAULTS_SLACK": "20"}, cwd=CHECKOUT,
        timeout=600, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stdout
    lines = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    results = {line["id"]: line for line in lines}
    assert results.keys() == sample.keys()
    for case, (cause, after) in sample.items():
        result = results[case]
        assert cause is None or [*cause] in result["signs"], result
        assert after == result["recovery"], result
        assert result["to_safe"] is None or 0 < result["to_safe"] <= result["bound"], result


def test_a_sample_of_the_random_faults() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pytest", str(CAMPAIGN.with_name("random_faults.py")), "-q",
         "-p", "no:cacheprovider"],
        env={**environment(0), "FAULTS_SEEDS": "50"}, cwd=CHECKOUT, timeout=300,
        capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stdout
