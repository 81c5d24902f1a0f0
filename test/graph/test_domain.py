"""The lock that keeps two bringups out of one namespace, the transport, and the executor."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from places import CONFIG

from greenroof_ros.common.errors import ConfigurationError, OccupiedError
from greenroof_ros.graph import domain
from greenroof_ros.graph.domain import only_bringup


def test_a_lock_that_is_a_link_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise another user could place a link there to have a file of this user emptied."""
    monkeypatch.setattr(domain, "_LOCKS", tmp_path)
    monkeypatch.setenv("ROS_DOMAIN_ID", "84")
    with only_bringup("/site1"):
        (lock,) = tmp_path.iterdir()
        with pytest.raises(OccupiedError), only_bringup("/site1"):
            pass
    lock.unlink()
    file = tmp_path / "file"
    file.write_text("of this user")
    lock.symlink_to(file)
    with pytest.raises(ConfigurationError, match="cannot be opened"), only_bringup("/site1"):
        pass
    assert file.read_text() == "of this user"


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

    rclpy.init(args=[])
    try:
        assert not isinstance(domain.make_executor(), SingleThreadedExecutor)
        monkeypatch.setitem(sys.modules, "rclpy.experimental", None)
        assert isinstance(domain.make_executor(), SingleThreadedExecutor)
    finally:
        rclpy.try_shutdown()
