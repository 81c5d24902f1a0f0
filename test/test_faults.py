"""A sample of the campaign of seeded faults; ``make faults`` runs all of it."""

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

Sample = Mapping[str, tuple[str | list[str], str]]

# Each fault with the cause that must be shown or named as the reason of the end, and with what must
# follow.
SAMPLE: Sample = {
    "site:danfoss_fc202/kill/pump/0": (["pump", "node_failed"], "ran again"),
    "site:danfoss_fc202/drive/drive_fault/0": (
        ["pump: pump", "drive_fault"], "ran again after ~/reset",
    ),
    "site:danfoss_fc202/sensor/roof_silent/0": (["pump: pump", "roof_level_unknown"], "ran again"),
    "site:danfoss_fc202/intruder/pump.command/0": (["pump: pump", "two_controllers"], "ran again"),
    "simulated/kill/weather/0": ("weather", "ended"),
    "relayed:danfoss_fc202/off/weather.precipitation/0": ("/weather/precipitation", "ended"),
    "service/fails/limit/0": (
        "429", "ran on; without a thermometer until the forecast was too old",
    ),
}

MQTT: Sample = {
    "mqtt:danfoss_fc202/broker/killed/0": (["cistern_sensor: sensor", "broker_lost"], "ran again"),
    "relay:tasmota/broker/killed/0": (["pump: pump", "drive_lost"], "ran again"),
    "relay:tasmota/drive/deaf/0": (["pump: pump", "second_master"], "ran again"),
}


def campaign(
    domain: int, results: Path, sample: Sample
) -> subprocess.CompletedProcess[str]:
    outside = {key: value for key, value in environment(domain).items()
               if not key.startswith("PYTEST_")}
    return subprocess.run(
        [
            sys.executable, "-m", "pytest", str(CHECKOUT / "tools/faults/campaign.py"), "-q", "-n",
            "2", "--dist", "loadgroup", "-p", "no:cacheprovider", "-k", " or ".join(sample),
        ],
        env={**outside, "FAULTS_RESULTS": str(results)}, cwd=CHECKOUT, timeout=240,
        capture_output=True, text=True,
    )


@pytest.mark.parametrize(
    "sample", [SAMPLE, pytest.param(MQTT, marks=needs_mosquitto)], ids=["modbus", "mqtt"]
)
def test_a_sample_of_the_campaign(
    domain: int, tmp_path: Path, sample: Sample
) -> None:
    """Each fault stops the pump within its bound and is named; then follows what is specified."""
    done = campaign(domain, tmp_path, sample)
    assert done.returncode == 0, done.stdout
    lines = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    results = {line["id"]: line for line in lines}
    assert results.keys() == sample.keys()
    for case, (cause, after) in sample.items():
        result = results[case]
        assert cause in (result["reason"] if isinstance(cause, str) else result["signs"]), result
        assert after == result["recovery"], result
        assert result["to_safe"] is None or 0 < result["to_safe"] <= result["bound"], result
    # Finished work is not repeated.
    assert f"{len(sample)} skipped" in campaign(domain, tmp_path, sample).stdout
