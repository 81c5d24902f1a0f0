"""A sample of the campaign of seeded faults; the whole of it is ``make faults``."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from graphs import environment
from places import CHECKOUT

pytest.importorskip("rclpy", reason="nodes need ROS 2")
pytest.importorskip("pymodbus", reason="drives are on Modbus")

# Each with what must be said of its cause, and what must come after.
SAMPLE = {
    "site:danfoss_fc202/kill/pump/0": ("pump: ended (SIGKILL)", "ran again"),
    "site:danfoss_fc202/drive/drive_fault/0": ("the drive reports", "~/reset (cleared:"),
    "site:danfoss_fc202/sensor/roof_silent/0": ("/roof/level", "ran again"),
    "site:danfoss_fc202/intruder/pump.command/0": ("publishers", "ran again"),
    "simulated/kill/weather/0": ("node weather ended (SIGKILL)", "exit code 1"),
}


def test_a_sample_of_the_campaign(domain: int, tmp_path: Path) -> None:
    """Each stops the pump within its bound, is named, and goes on as specified."""
    done = subprocess.run(
        [
            sys.executable, str(CHECKOUT / "test" / "faults"), "--lanes", "2", "--results",
            str(tmp_path), "--only", *SAMPLE,
        ],
        env=environment(domain), capture_output=True, text=True, timeout=240,
    )
    assert done.returncode == 0, done.stdout
    lines = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    results = {line["id"]: line for line in lines}
    assert results.keys() == SAMPLE.keys()
    for case, (cause, after) in SAMPLE.items():
        result = results[case]
        assert cause in result["alarm"], result
        assert after in result["recovery"], result
        assert 0 < result["to_safe"] <= result["bound"], result
    # What is done is not done again.
    again = subprocess.run(
        [
            sys.executable, str(CHECKOUT / "test" / "faults"), "--results", str(tmp_path),
            "--only", *SAMPLE,
        ],
        env=environment(domain), capture_output=True, text=True, timeout=60,
    )
    assert again.stdout.startswith(f"0 of {len(SAMPLE)} cases to do"), again.stdout


def test_a_smaller_campaign_still_has_every_kind_of_fault_in_each_way() -> None:
    """And each target of a kind once before any comes twice."""
    sys.path.insert(0, str(CHECKOUT / "test" / "faults"))
    try:
        from cases import WAYS, all_cases, sample
    finally:
        del sys.path[0]
    cases = all_cases()
    assert len(cases) >= 1000
    every = {(case.way, case.fault) for case in cases}
    assert {way for way, _ in every} == set(WAYS)
    for divisor, seed in ((3, 1), (50, 2), (10**6, 3)):
        chosen = sample(cases, divisor, seed)
        assert {(case.way, case.fault) for case in chosen} == every
        assert len(chosen) <= len(cases) / divisor + len(every)
    assert len(sample(cases, 10**6, 1)) == len(every)
    quarter = sample(cases, 4, 1)
    for way, fault in every:
        targets = {case.target for case in cases if (case.way, case.fault) == (way, fault)}
        those = [case.target for case in quarter if (case.way, case.fault) == (way, fault)]
        assert len(set(those)) == min(len(those), len(targets))
