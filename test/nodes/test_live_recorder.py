"""The recorder of a live site as a node: what it keeps, and what a full disk does to it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from disks import disk_that_hangs, small_disk
from graphs import environment
from rosbags.highlevel import AnyReader

rclpy = pytest.importorskip("rclpy", reason="nodes need ROS 2")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from test_live import ERROR, OK, Site, observer, site  # noqa: E402, F401
from test_nodes import qos  # noqa: E402


@contextmanager
def recorder(domain: int, directory: Path) -> Iterator[subprocess.Popen[str]]:
    """Record, and end well."""
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros.nodes.live_recorder", "--ros-args",
         "-p", f"directory:={directory}"],
        env=environment(domain), stderr=subprocess.PIPE, text=True,
    )
    try:
        yield process
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGTERM)
        code = process.wait(300)
    assert code == 0


def test_all_that_comes_is_kept(domain: int, tmp_path: Path, site: Site) -> None:  # noqa: F811
    """Of topics that come and go, each message once, in order, at the time when it came."""
    with recorder(domain, tmp_path / "bag"):
        site.until(site.says("/recorder: recording", OK, str(tmp_path / "bag")), 60, "a start")
        outflow = site.publisher("/pump/flow")
        site.until(lambda: outflow.get_subscription_count() == 1, 60, "the recorder's subscription")
        sent = []
        site.values = {"/pump/flow": lambda now: sent.append((time.time(), now)) or now}
        began = time.time()
        site.during(3)
        ended = time.time()
    with AnyReader([tmp_path / "bag"]) as reader:
        kept = [
            (stamp / 1e9, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages()
            if connection.topic == "/pump/flow"
        ]
    values = [value for _, value in sent]
    # A publisher that is new is not at once connected, and what it says then is past.
    assert len(kept) > 20 and [value for _, value in kept] == values[-len(kept):]
    assert began <= kept[0][0] and kept[-1][0] <= ended + 30
    late = {value: time_sent for time_sent, value in sent}
    assert max(stamp - late[value] for stamp, value in kept) < 30


def test_a_full_disk_is_an_alarm_and_no_end(
    domain: int, tmp_path: Path, site: Site,  # noqa: F811
) -> None:
    disk = tmp_path / "disk"
    with small_disk(disk, "16k"):
        (disk / "other").write_bytes(bytes(16384))
        with recorder(domain, disk / "bag") as process:
            full = site.says(
                "/recorder: recording", ERROR, "nothing is recorded", "No space left on device"
            )
            site.until(full, 60, "the alarm")
            site.during(2)
            assert full() and process.poll() is None


def test_a_disk_that_hangs_for_half_a_minute_costs_nothing(
    domain: int, tmp_path: Path, site: Site,  # noqa: F811
) -> None:
    """The node answers all the time, and what came meanwhile is in the bag, with its times."""
    disk = tmp_path / "disk"
    with disk_that_hangs(disk) as hang:
        with recorder(domain, disk / "bag"):
            site.until(site.says("/recorder: recording", OK), 60, "a start")
            outflow = site.publisher("/pump/flow")
            site.until(lambda: outflow.get_subscription_count() == 1, 60, "the subscription")
            sent = []
            site.values = {"/pump/flow": lambda now: sent.append(now) or now}
            site.during(3)
            hang(True)
            heard = reports_of_recorder(site)
            site.until(
                site.says("/recorder: recording", ERROR, "what comes waits in memory"), 30,
                "the alarm",
            )
            site.during(30)
            # bringup kills who is silent for 5 s.
            assert len(heard) > 30 and max(b - a for a, b in pairwise(heard)) < 4
            hang(False)
            site.until(site.says("/recorder: recording", OK), 60, "its end")
            site.during(1)
        with AnyReader([disk / "bag"]) as reader:
            kept = [
                (stamp / 1e9, reader.deserialize(raw, connection.msgtype).data)
                for connection, stamp, raw in reader.messages()
                if connection.topic == "/pump/flow"
            ]
    assert len(kept) > 300 and [value for _, value in kept] == sent[-len(kept):]
    assert max(b - a for (a, _), (b, _) in pairwise(kept)) < 4


def reports_of_recorder(site: Site) -> list[float]:  # noqa: F811
    """Return when the recorder says how it is, from now on."""
    heard: list[float] = []

    def note(array: DiagnosticArray) -> None:
        if any(status.name == "/recorder" for status in array.status):
            heard.append(time.monotonic())

    site.node.create_subscription(DiagnosticArray, "/diagnostics", note, qos("/diagnostics"))
    return heard
