"""The environment, the lock of a namespace, and the transport."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import CONFIG
from refusals import refusal

from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.ros.domain import lock_bringup, prepare_ros


def test_one_bringup_in_a_namespace() -> None:
    """Its lock has no file that a cleaner, or systemd at the end of a session, could remove."""
    places = [Path("/dev/shm"), Path("/tmp"), Path("/run/lock")]
    before = {file for place in places for file in place.glob("greenroof_ros*")}
    for _ in range(2):
        with lock_bringup("/site1"), lock_bringup("/site2"):
            assert {file for place in places for file in place.glob("greenroof_ros*")} <= before
            with pytest.raises(OccupiedError), lock_bringup("/site1"):
                pass


@pytest.mark.parametrize("kind", ["", "_loopback"])
def test_files_of_profiles_differ_only_in_what_they_are_for(kind: str) -> None:
    """Fast DDS reads one file, on loopback only or not; in version 3 two names are new."""
    files = {
        name: ElementTree.parse(CONFIG / f"{name}.xml").getroot()
        for name in ("fastdds", f"fastdds{kind}", f"fastdds3{kind}")
    }
    usual, publisher = (
        files[name].find("{*}publisher") for name in ("fastdds", f"fastdds{kind}")
    )
    assert usual is not None and publisher is not None
    assert ElementTree.tostring(usual).strip() == ElementTree.tostring(publisher).strip()
    text, new = (
        ElementTree.tostring(files[name + kind], "unicode") for name in ("fastdds", "fastdds3")
    )
    for before, after in (
        ("nackSupressionDuration", "nack_supression_duration"),
        ("heartbeatPeriod", "heartbeat_period"),
    ):
        assert text.count(before) == 2
        text = text.replace(before, after)
    assert new == text


def test_values_that_ros_would_replace(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its own values, messages may leave this machine. A broken ROS is reported as one."""
    pytest.importorskip("rclpy", reason="it is about ROS 2")
    monkeypatch.setattr(os, "environ", {**os.environ})
    for variable, value, words in (
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "did you mean LOCALHOST?"),  # rcl: SUBNET
        ("ROS_DOMAIN_ID", "abc", "must be a whole number from 0 to 101"),
    ):
        os.environ[variable] = value
        message = refusal(prepare_ros)
        assert message.startswith(f"{variable} = {value!r}: ") and words in message
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert refusal(prepare_ros).startswith("ROS 2 is not available (")
