"""The environment, the lock of a namespace, the transport, and the executor."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import CHECKOUT, CONFIG
from refusals import refusal

from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.ros.domain import lock_bringup, prepare_ros


def test_one_bringup_in_a_namespace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its lock has no file that a cleaner, or systemd at the end of a session, could remove."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "84")
    places = [Path("/dev/shm"), Path("/tmp"), Path("/run/lock")]
    before = {file for place in places for file in place.glob("greenroof_ros*")}
    with lock_bringup("/site1"):
        assert {file for place in places for file in place.glob("greenroof_ros*")} <= before
        with pytest.raises(OccupiedError) as occupied, lock_bringup("/site1"):
            pass
        # Of a run or a live site: another place is chosen in the same way for both.
        assert "use another --namespace, ROS_DOMAIN_ID or" in str(occupied.value)
        assert "greenroof" not in str(occupied.value)
        with lock_bringup("/site2"):
            pass
    with lock_bringup("/site1"):
        pass


def test_a_broken_ros_is_reported_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "environ", {**os.environ})
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert refusal(prepare_ros).startswith("ROS 2 is not available (")


def test_files_of_profiles_differ_only_in_what_they_are_for() -> None:
    """Fast DDS reads one file, on loopback only or not; in version 3 two names are new."""
    files = {
        name: ElementTree.parse(CONFIG / f"{name}.xml").getroot()
        for name in ("fastdds", "fastdds_loopback", "fastdds3", "fastdds3_loopback")
    }
    publishers = {
        ElementTree.tostring(files[name].find("{*}publisher")).strip()
        for name in ("fastdds", "fastdds_loopback")
    }
    assert len(publishers) == 1
    for kind in ("", "_loopback"):
        text, new = (ElementTree.tostring(files[name + kind]) for name in ("fastdds", "fastdds3"))
        for before, after in (
            (b"nackSupressionDuration", b"nack_supression_duration"),
            (b"heartbeatPeriod", b"heartbeat_period"),
        ):
            assert text.count(before) == 2
            text = text.replace(before, after)
        assert new == text


@pytest.mark.parametrize(
    ("variable", "value", "words"),
    [
        ("ROS_DOMAIN_ID", "abc", "must be a whole number from 0 to 101"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "localhost", "did you mean LOCALHOST?"),  # rcl: SUBNET
    ],
)
def test_values_that_ros_would_replace(
    variable: str, value: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its own values, messages may leave this machine."""
    pytest.importorskip("rclpy", reason="it is about ROS 2")
    monkeypatch.setenv(variable, value)
    message = refusal(prepare_ros)
    assert message.startswith(f"{variable} = {value!r}: ") and words in message


def test_importing_nodes_and_commands_changes_nothing_in_the_process() -> None:
    code = (
        "import logging, signal, sys, rclpy, std_msgs.msg;"
        "state = lambda: (logging.raiseExceptions, sys.excepthook, len(sys.meta_path),"
        " [name for name in sys.modules if sys.modules[name] is None],"
        " [signal.getsignal(number) for number in signal.valid_signals()]);"
        "before = state();"
        "import greenroof_ros.live.pump, greenroof_ros.bringup.composition,"
        " greenroof_ros.bringup.live, greenroof_ros.watch.graph_client;"
        "assert state() == before, state()"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=CHECKOUT)
