"""Bags: an independent reader opens them, and a full disk leaves what was recorded.

What a killed recorder leaves is in the sample of the campaign, test_faults.py.
"""

from __future__ import annotations

import re
import subprocess
from collections import Counter
from pathlib import Path

from bag_topics import MPC_TOPICS
from commands import run_command
from disks import small_disk
from graphs import Process, environment, summary_of
from rosbags.highlevel import AnyReader


def recover(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the recovery as a user would."""
    return run_command("recover", str(directory), *arguments, cwd=Path.cwd(), env=environment(0))


def test_rosbags_decodes_it(recorded: Path) -> None:
    """An independent rosbag2 reader finds each message and decodes it."""
    with AnyReader([recorded / "bag"]) as reader:
        messages = [
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages()
        ]
    assert Counter(topic for topic, *_ in messages) == dict.fromkeys(MPC_TOPICS, 361)
    # Tick 0 is 2021-07-07T02:00-05:00, 1625641200 s after 1970 (date -d ... +%s).
    assert [
        (time_ns, message.clock.sec) for topic, time_ns, message in messages if topic == "/clock"
    ] == [((1_625_641_200 + tick) * 10**9, 1_625_641_200 + tick) for tick in range(361)]
    for topic, _, message in messages:
        if topic == "/forecast/precipitation":
            front = message.data[: message.layout.data_offset]
            # The end of each of ten ticks, and its rain.
            assert (front[1:].tolist(), len(message.data) - len(front)) == (list(range(1, 11)), 10)


def test_full_disk(domain: int, tmp_path: Path) -> None:
    """A disk that fills up is an error that reports it, and the bag can be recovered."""
    disk = tmp_path / "disk"
    with small_disk(disk, "200k"):
        process = Process(
            domain, "bringup", "--controller", "onoff", "--output", str(disk / "run"), cwd=tmp_path
        )
        assert process.wait(120) == 1
        assert "No space left on device" in process.stderr()
        assert "Traceback" not in process.stderr()
        summary = summary_of(disk / "run")
        assert summary["status"] == "failed"
        reason = re.fullmatch(
            r".*/bag: No space left on device; "
            r"'greenroof recover .*/bag' restores the first (\d+) ticks of the bag",
            summary["reason"],
        )
        assert reason is not None, summary["reason"]
        assert summary["reason"] in process.stderr()
        recovered = recover(disk / "run")
        assert recovered.returncode == 2
        assert "bag-recovered: cannot be written: No space left on device" in recovered.stderr
        assert not (disk / "run" / "bag-recovered").exists()
        done = recover(disk / "run", "--output", str(tmp_path / "rescued"))
        assert done.returncode == 0, done.stderr
        with AnyReader([tmp_path / "rescued"]) as reader:
            (ticks,) = {connection.msgcount for connection in reader.connections}
        assert ticks == int(reason[1]) > 300
        assert ticks <= summary["last_tick"] <= ticks + 64
