"""The lock that keeps two bringups out of one namespace, the transport, and the executor."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import CONFIG

from greenroof_ros.base.errors import OccupiedError
from greenroof_ros.graph.domain import lock_namespace


def test_one_bringup_in_a_namespace(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its lock has no file that a cleaner, or systemd at the end of a session, could remove."""
    monkeypatch.setenv("ROS_DOMAIN_ID", "84")
    places = [Path("/dev/shm"), Path("/tmp"), Path("/run/lock")]
    before = {file for place in places for file in place.glob("greenroof_ros*")}
    with lock_namespace("/site1"):
        assert {file for place in places for file in place.glob("greenroof_ros*")} <= before
        with pytest.raises(OccupiedError), lock_namespace("/site1"):
            pass
        with lock_namespace("/site2"):
            pass
    with lock_namespace("/site1"):
        pass


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


def test_an_rclpy_without_the_fast_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow executor is used instead."""
    rclpy = pytest.importorskip("rclpy", reason="it is about ROS 2")
    from rclpy.executors import SingleThreadedExecutor

    from greenroof_ros.graph.spin import make_executor

    rclpy.init(args=[])
    try:
        assert not isinstance(make_executor(), SingleThreadedExecutor)
        monkeypatch.setitem(sys.modules, "rclpy.experimental", None)
        assert isinstance(make_executor(), SingleThreadedExecutor)
    finally:
        rclpy.try_shutdown()
