"""The bag of a live site: split, bounded, readable while it grows, and what a kill leaves."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest
import yaml
from commands import run_command
from disks import no_file_beyond
from graphs import environment
from places import CHECKOUT
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.common.interface import read_topics
from greenroof_ros.recording.bag_writer import LiveBag
from greenroof_ros.recover import restore

# 2026-11-21 23:00:00 UTC, by date -d.
LATE_NS = 1795302000 * 10**9
TOPICS = ("/roof/level", "/cistern/level", "/pump/command")


def make(
    directory: Path, file_bytes: int = 10**7, total_bytes: int = 10**9, namespace: str = ""
) -> LiveBag:
    interface = read_topics()
    topics = [
        replace(topic, name=namespace + topic.name)
        for topic in (interface[name] for name in TOPICS)
    ]
    topics.append(interface["/diagnostics"])
    return LiveBag(directory, topics, file_bytes=file_bytes, total_bytes=total_bytes)


def number(value: float) -> bytes:
    """Return a Float64 in CDR: little-endian header, then the number."""
    return struct.pack("<Id", 256, value)


def read(bag: Path) -> list[tuple[str, int, float]]:
    """Return what rosbags finds in a bag, in the order of time."""
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages()
        ]


def test_what_came_is_read_back_with_its_times(tmp_path: Path) -> None:
    """Irregular times, one topic oftener than the other, over midnight of UTC: two files."""
    bag = make(tmp_path / "bag")
    sent = [
        (TOPICS[i % 3 % 2], LATE_NS + i * 7_000_000_123, i / 7) for i in range(1000)
    ]  # 7000 s from 23:00 on
    for topic, stamp, value in sent:
        bag.write(topic, stamp, number(value), stamp / 1e9)
    bag.close()
    assert bag.problem == ""
    assert (bag.recorded, bag.lost) == (1000, 0)
    assert read(tmp_path / "bag") == sent
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == [
        "bag_0.mcap", "bag_1.mcap", "metadata.yaml"
    ]
    with AnyReader([tmp_path / "bag" / "bag_1.mcap"]) as reader:
        assert reader.start_time >= LATE_NS + 3600 * 10**9
    about = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    about = about["rosbag2_bagfile_information"]
    assert about["message_count"] == 1000
    assert about["starting_time"]["nanoseconds_since_epoch"] == LATE_NS
    assert about["duration"]["nanoseconds"] == 999 * 7_000_000_123
    assert [file["message_count"] for file in about["files"]] == [515, 485]  # 3600 / 7 is 514.3


def test_oldest_files_go_beyond_the_limit(tmp_path: Path) -> None:
    """The bag stays within it and readable all the time, and its newest messages are there."""
    bag, random = make(tmp_path / "bag", file_bytes=20_000, total_bytes=100_000), Random(1)
    at, largest, directory = 0.0, 0, tmp_path / "bag"
    for message in range(8_000):
        at += 0.25
        bag.write(TOPICS[0], LATE_NS + int(at * 1e9), number(random.random()), at)
        bag.look(at)
        if message % 500 == 499:
            size = sum(path.stat().st_size for path in directory.glob("*.mcap"))
            largest = max(largest, size)
            if size > 60_000:
                assert read(directory)
    bag.close()
    assert bag.recorded == 8_000
    # What came since the last flush, forty messages, may be on top.
    assert 80_000 < largest < 102_000
    stamps = [stamp for _, stamp, _ in read(directory)]
    assert stamps[-1] == LATE_NS + int(at * 1e9)
    assert {after - before for before, after in pairwise(stamps)} == {250_000_000}
    assert not (directory / "bag_0.mcap").exists()


_WRITER = """
import sys, time
from test_live_bag import LATE_NS, TOPICS, make, number
from pathlib import Path
bag = make(Path(sys.argv[1]), file_bytes=20_000, namespace="/site1")
for tick in range(1500):
    bag.write("/site1" + TOPICS[tick % 3], LATE_NS + tick * 10**9, number(tick * 1.1), float(tick))
    bag.look(float(tick))
print(len(list(Path(sys.argv[1]).glob("*.mcap"))), flush=True)
time.sleep(60)
"""


def test_a_kill_costs_what_came_since_the_last_flush(tmp_path: Path) -> None:
    """The closed files are a bag at once; recover restores the last; a new start goes on."""
    path = os.pathsep.join(map(str, (CHECKOUT, CHECKOUT / "test", Path(__file__).parent)))
    process = subprocess.Popen(
        [sys.executable, "-c", _WRITER, str(tmp_path / "bag")], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert process.stdout is not None
    files = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert files > 2
    sent = [
        ("/site1" + TOPICS[tick % 3], LATE_NS + tick * 10**9, tick * 1.1) for tick in range(1500)
    ]
    closed = read(tmp_path / "bag")
    assert closed == sent[: len(closed)]
    done = run_command("recover", str(tmp_path / "bag"), cwd=tmp_path, env=environment(0))
    assert done.returncode == 0, done.stderr
    restored = read(tmp_path / "bag-recovered")
    assert len(closed) < len(restored) and restored == sent[: len(restored)]
    assert len(restored) >= 1500 - 11  # ten seconds, and the message that a flush follows
    assert done.stdout.startswith(f"{len(restored)} messages recovered to ")
    bag = make(tmp_path / "bag", file_bytes=20_000, namespace="/site1")
    bag.write("/site1/roof/level", LATE_NS + 4000 * 10**9, number(1.0), 4000.0)
    bag.close()
    assert (tmp_path / "bag" / f"bag_{files}.mcap").exists()
    assert read(tmp_path / "bag") == [
        *closed, ("/site1/roof/level", LATE_NS + 4000 * 10**9, 1.0)
    ]


@pytest.mark.parametrize("room", range(6000, 14_000, 1000))
def test_recording_that_fails_tries_again(tmp_path: Path, room: int) -> None:
    """Wherever the room ends: the rest is lost, counted, and said until something is safe."""
    bag, random = make(tmp_path / "bag"), Random(1)
    values = [random.random() for _ in range(3000)]

    def write(second: int) -> None:
        bag.write(TOPICS[0], LATE_NS + second * 10**9, number(values[second]), float(second))
        bag.look(float(second))

    second = 0
    with no_file_beyond(room):
        while not bag.problem:
            write(second)
            second += 1
        assert bag.problem == f"{tmp_path / 'bag'}: File too large"
        assert 0 < bag.lost < second
    with no_file_beyond(50):  # it tries again in vain, and nothing of that is left
        for later in range(second, second + 100):
            write(later)
        assert bag.problem and bag.lost > 100 and len(list(bag.directory.iterdir())) == 1
        second, lost = second + 100, bag.lost
    for later in range(second, 3000):
        write(later)
    assert bag.problem == ""
    assert bag.lost <= lost + 60  # one wait
    bag.close()
    assert bag.recorded + bag.lost == 3000
    restore(tmp_path / "bag", tmp_path / "restored")
    restored = read(tmp_path / "restored")
    assert len(restored) == bag.recorded
    assert set(restored) <= {
        (TOPICS[0], LATE_NS + second * 10**9, value) for second, value in enumerate(values)
    }
