"""The recorder of a live site as a node: what it keeps, and what a full disk does to it."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from disks import small_disk
from ros_rig import ERROR, OK, Site, start_node
from rosbags.highlevel import AnyReader


@contextmanager
def recorder(domain: int, directory: Path) -> Iterator[subprocess.Popen[Any]]:
    """Record, and end well."""
    process = start_node(domain, directory.parent, "live_recorder", directory=directory)
    try:
        yield process
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGTERM)
        code = process.wait(300)
    assert code == 0


def flows(bag: Path) -> list[tuple[float, float]]:
    """Return the flows of a bag, each with its time (s since 1970)."""
    with AnyReader([bag]) as reader:
        return [
            (stamp / 1e9, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages() if connection.topic == "/pump/flow"
        ]


def test_all_that_comes_is_kept(domain: int, tmp_path: Path, site: Site) -> None:
    """Of topics that come and go, each message once, in order, at the time when it came."""
    with recorder(domain, tmp_path / "bag"):
        site.until(site.says("/recorder: recording", OK, str(tmp_path / "bag")), 60, "a start")
        outflow = site.watcher.publisher("/pump/flow")
        site.until(lambda: outflow.get_subscription_count() == 1, 60, "the recorder's subscription")
        sent = []
        site.values = {"/pump/flow": lambda now: sent.append((time.time(), now)) or now}
        began = time.time()
        site.during(3)
        ended = time.time()
    kept = flows(tmp_path / "bag")
    values = [value for _, value in sent]
    # A publisher that is new is not at once connected, and what it says then is past.
    assert len(kept) > 20 and [value for _, value in kept] == values[-len(kept):]
    assert began <= kept[0][0] and kept[-1][0] <= ended + 30
    late = {value: time_sent for time_sent, value in sent}
    assert max(stamp - late[value] for stamp, value in kept) < 30


def test_a_full_disk_is_an_alarm_and_no_end(domain: int, tmp_path: Path, site: Site) -> None:
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
