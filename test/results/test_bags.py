"""Bags of simulations and live sites: any reader gets back what was written; and recovery."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random
from types import SimpleNamespace

import pytest
import yaml
from commands import run_command
from disks import bad_disk, no_file_beyond
from graphs import environment
from mcap.reader import make_reader
from mcap.records import ChunkIndex
from places import refusal
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.commands.recover import recover
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.recorder import LiveBag
from greenroof_ros.results.bag_read import count_ticks, find_namespace
from greenroof_ros.results.bag_write import BagWriter

START_NS = 1625641200 * 10**9  # 07:00 UTC, by date -d
TOPICS = (
    "/roof/level", "/cistern/level", "/pump/command", "/pump/flow", "/weather/precipitation"
)


def bag_writer(directory: Path) -> BagWriter:
    """Begin a bag of a simulation, with its clock."""
    interface = read_topics()
    return BagWriter(directory, [interface[name] for name in ("/clock", *TOPICS)])


def number(value: float) -> bytes:
    """Return a Float64 in CDR: little-endian header, then the number."""
    return struct.pack("<Id", 256, value)


def clock(time_ns: int) -> bytes:
    """Return a Clock in CDR."""
    return struct.pack("<III", 256, time_ns // 10**9, time_ns % 10**9)


Message = tuple[str, int, int, bytes]
"""topic, time, tick and content"""


def write_ticks(writer: BagWriter, ticks: int, size: int = 8) -> list[Message]:
    """Write messages of this size, and return them."""
    random, written = Random(1), []
    for tick in range(ticks):
        time_ns = START_NS + tick * 10**9
        messages = {"/clock": clock(time_ns)} | {
            topic: number(tick + index / 10) + random.randbytes(size - 8)
            for index, topic in enumerate(TOPICS)
        }
        writer.write_tick(time_ns, list(messages.values()))
        written += [(topic, time_ns, tick, message) for topic, message in messages.items()]
    return written


def write_bag(directory: Path, ticks: int, size: int = 8) -> list[Message]:
    """Write a whole bag, and return its messages."""
    writer = bag_writer(directory)
    written = write_ticks(writer, ticks, size)
    writer.close()
    return written


def messages_of(file: Path) -> list[Message]:
    """Return a file's messages by the format's own library."""
    with file.open("rb") as stream:
        return [
            (channel.topic, message.log_time, message.sequence, message.data)
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]


def test_a_whole_bag_comes_out_as_it_is(tmp_path: Path) -> None:
    """The format's own library finds what was written, before and after recovery."""
    written = write_bag(tmp_path / "bag", 200)
    assert messages_of(tmp_path / "bag" / "bag_0.mcap") == written
    assert recover(tmp_path) == (tmp_path / "bag-recovered", 1200, [])
    assert messages_of(tmp_path / "bag-recovered" / "bag-recovered_0.mcap") == written


def damaged(bag: Path, at: int, content: bytes | None = None) -> None:
    """Overwrite a part of a bag's file, or flip a bit; an offset below 0 is from the file's end."""
    with (bag / "bag_0.mcap").open("r+b") as stream:
        at = stream.seek(at, os.SEEK_END if at < 0 else os.SEEK_SET)
        content = content or bytes([stream.read(1)[0] ^ 8])
        stream.seek(at)
        stream.write(content)


def chunks(bag: Path) -> list[ChunkIndex]:
    """Return where a bag's chunks are, by the format's own library."""
    with (bag / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary.chunk_indexes


def lost_ticks(new: Path, written: list[Message]) -> list[int]:
    """Return the ticks that a recovered bag lacks; two readers find the others in it, whole."""
    restored = messages_of(new / f"{new.name}_0.mcap")
    there = {tick for *_, tick, _ in restored}
    assert restored == [message for message in written if message[2] in there]
    with AnyReader([new]) as reader:
        assert reader.message_count == len(restored)
        assert sorted(
            (connection.topic, stamp, data) for connection, stamp, data in reader.messages()
        ) == sorted((topic, stamp, data) for topic, stamp, _, data in restored)
    return sorted({message[2] for message in written} - there)


FIRST, SECOND, THIRD_ON = list(range(16)), list(range(16, 32)), list(range(32, 361))
# What is damaged, given its chunks, and which ticks are lost: a chunk has 16. First while the index
# at the file's end tells where the chunks are, then without it, as after a kill.
DAMAGE: dict[str, tuple[Callable[[Path, list[ChunkIndex]], object], list[int], list[int]]] = {
    "a bit in the middle of a chunk's data": (
        lambda bag, parts: damaged(
            bag, parts[1].chunk_start_offset + parts[1].chunk_length // 2
        ), SECOND, SECOND,
    ),
    "the first chunk, which defines the topics": (
        lambda bag, parts: damaged(bag, parts[0].chunk_start_offset + 200, bytes(100)), FIRST,
        list(range(361)),
    ),
    "both lengths": (
        lambda bag, parts: (
            damaged(bag, parts[1].chunk_start_offset + 1, b"\xff" * 8),
            damaged(bag, parts[1].chunk_start_offset + 49, b"\xff" * 8),
        ), SECOND, SECOND + THIRD_ON,
    ),
}


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("what", DAMAGE)
def test_what_is_whole_is_recovered_after_any_damage(
    tmp_path: Path, what: str, closed: bool
) -> None:
    """Without the index nothing is found behind a wrong length, but that is reported."""
    written = write_bag(tmp_path / "bag", 361)
    damage, *lost = DAMAGE[what]
    damage(tmp_path / "bag", chunks(tmp_path / "bag"))
    if not closed:
        damaged(tmp_path / "bag", -30, bytes(20))
        (tmp_path / "bag" / "metadata.yaml").unlink()
    assert count_ticks(tmp_path / "bag") == (361 if closed else None)
    if lost[not closed] == list(range(361)):
        assert "does not contain an intact chunk" in refusal(recover, tmp_path)
        return
    new, messages, losses = recover(tmp_path)
    assert messages == 6 * (361 - len(lost[not closed]))
    assert lost_ticks(new, written) == lost[not closed]
    assert count_ticks(new) == messages // 6
    assert bool(losses) == bool(lost[not closed])


@pytest.mark.parametrize("seed", range(30))
def test_whatever_a_file_contains_nothing_wrong_comes_out(tmp_path: Path, seed: int) -> None:
    """Wherever it is cut and overwritten: any loss is reported, or there is a clear error."""
    written, random = write_bag(tmp_path / "bag", 64), Random(seed)
    file = tmp_path / "bag" / "bag_0.mcap"
    content = file.read_bytes()
    file.write_bytes(content[: random.choice((len(content), random.randrange(len(content))))])
    for _ in range(random.choice((1, 8))):
        wrong = random.choice((b"x", bytes(8), b"\xff" * 8, b"\0" * 7 + b"\x7f"))
        damaged(tmp_path / "bag", random.randrange(file.stat().st_size), wrong)
    try:
        new, _, losses = recover(tmp_path)
    except ConfigurationError:
        assert not (tmp_path / "bag-recovered").exists()
    else:
        assert bool(losses) == bool(lost_ticks(new, written))


@pytest.mark.parametrize(
    ("what", "where"),
    [("BAD_SECTOR", 0.0), ("BAD_SECTOR", 0.5), ("BAD_SECTOR", 1.0), ("CUT_TO", 0.6)],
)
def test_a_disk_that_fails_while_it_is_read(tmp_path: Path, what: str, where: float) -> None:
    """A sector that gives an error, or a file that is cut meanwhile: what was lost is reported.

    A chunk has 16 ticks; a sector can touch three. Without the index, in the last sector, each
    record's length leads to the next.
    """
    written = write_bag(tmp_path / "bag", 361, size=200)
    size = (tmp_path / "bag" / "bag_0.mcap").stat().st_size
    at = int(where * size) // 4096 * 4096
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "recover", "bag", "--output", "new"], cwd=tmp_path,
        env={**environment(0), **bad_disk(tmp_path), what: str(at)}, capture_output=True,
        text=True, check=False,
    )
    missing = lost_ticks(tmp_path / "new", written)
    assert done.returncode == bool(missing), done.stderr
    assert bool(missing) == ("lost" in done.stderr) == (where < 1)
    if missing:
        assert missing == list(range(missing[0], missing[-1] + 1))
        assert len(missing) <= (48 if what == "BAD_SECTOR" else 361 * (1 - where) + 48)


@pytest.mark.parametrize("room", range(20_000, 24_000, 1000))
def test_a_file_that_cannot_grow_keeps_what_was_safe(tmp_path: Path, room: int) -> None:
    """Wherever in its chunks the room ends: exactly the ticks that the writer reports as safe."""
    writer = bag_writer(tmp_path / "bag")
    with no_file_beyond(room), pytest.raises(OSError, match="File too large"):
        write_ticks(writer, 2000, size=16)
    writer.cut()
    assert writer.safe > 0
    assert recover(tmp_path) == (tmp_path / "bag-recovered", 6 * writer.safe, [])


# --- live sites: split, bounded, readable while growing, and after a kill -------------------------

# 2026-11-21 23:00:00 UTC, by date -d.
LATE_NS = 1795302000 * 10**9


def live_bag(
    directory: Path, file_bytes: int = 10**7, total_bytes: int = 10**9, namespace: str = ""
) -> LiveBag:
    interface = read_topics()
    topics = [
        replace(topic, name=namespace + topic.name)
        for topic in (interface[name] for name in TOPICS[:3])
    ]
    topics.append(interface["/diagnostics"])
    return LiveBag(directory, topics, file_bytes=file_bytes, total_bytes=total_bytes)


def read(bag: Path) -> list[tuple[str, int, float]]:
    """Return what rosbags finds in a bag, in the order of time."""
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        return [
            (connection.topic, stamp, reader.deserialize(raw, connection.msgtype).data)
            for connection, stamp, raw in reader.messages()
        ]


def test_what_came_is_read_back_with_its_times(tmp_path: Path) -> None:
    """Irregular times, one topic more often than the other, over midnight UTC: two files."""
    bag = live_bag(tmp_path / "bag")
    sent = [
        (TOPICS[i % 3 % 2], LATE_NS + i * 7_000_000_123, i / 7) for i in range(1000)
    ]  # 7000 s from 23:00 on
    for topic, stamp, value in sent:
        bag.write(topic, stamp, number(value), stamp / 1e9)
    bag.close()
    assert bag.problem == ""
    assert read(tmp_path / "bag") == sent
    about = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    about = about["rosbag2_bagfile_information"]
    assert about["message_count"] == 1000
    assert about["starting_time"]["nanoseconds_since_epoch"] == LATE_NS
    assert about["duration"]["nanoseconds"] == 999 * 7_000_000_123
    assert [file["message_count"] for file in about["files"]] == [515, 485]  # 3600 / 7 is 514.3


def write_second(bag: LiveBag, second: int, value: float, topic: str = TOPICS[0]) -> None:
    bag.write(topic, LATE_NS + second * 10**9, number(value), float(second))
    bag.flush_if_due(float(second))


def split_bag(directory: Path, namespace: str = "") -> tuple[LiveBag, list[tuple[str, int, float]]]:
    """Begin a live site's bag of some files; return it with its messages."""
    sent = [
        (namespace + TOPICS[tick % 3], LATE_NS + tick * 10**9, tick * 1.1) for tick in range(1500)
    ]
    bag = live_bag(directory, file_bytes=20_000, namespace=namespace)
    for tick, (topic, _, value) in enumerate(sent):
        write_second(bag, tick, value, topic)
    return bag, sent


def test_a_kill_costs_what_came_since_the_last_flush(tmp_path: Path) -> None:
    """The closed files are readable at once; recover restores the last; a new start continues.

    A copy of the files that are being written is what a kill leaves.
    """
    killed, sent = split_bag(tmp_path / "growing" / "bag", "/site1")
    shutil.copytree(tmp_path / "growing", tmp_path, dirs_exist_ok=True)
    killed.close()
    files = len(list((tmp_path / "bag").glob("*.mcap")))
    assert files > 2
    closed = read(tmp_path / "bag")
    assert closed == sent[: len(closed)]
    done = run_command("recover", str(tmp_path / "bag"), cwd=tmp_path, env=environment(0))
    assert done.returncode == 0, done.stderr
    restored = read(tmp_path / "bag-recovered")
    assert len(closed) < len(restored) and restored == sent[: len(restored)]
    assert len(restored) >= 1500 - 11  # ten seconds, and the message that is followed by a flush
    bag = live_bag(tmp_path / "bag", file_bytes=20_000, namespace="/site1")
    bag.write("/site1/roof/level", LATE_NS + 4000 * 10**9, number(1.0), 4000.0)
    bag.close()
    assert (tmp_path / "bag" / f"bag_{files}.mcap").exists()
    assert read(tmp_path / "bag") == [
        *closed, ("/site1/roof/level", LATE_NS + 4000 * 10**9, 1.0)
    ]


def test_every_file_of_a_split_bag_is_checked(tmp_path: Path) -> None:
    """An older one cannot be read: the metadata has its number of messages."""
    bag, sent = split_bag(tmp_path / "bag")
    bag.close()
    file = tmp_path / "bag" / "bag_1.mcap"
    had = {message[:2] for message in messages_of(file)}
    file.unlink()
    file.symlink_to("bag_1.mcap")  # to itself, since root may read anything
    new, _, losses = recover(tmp_path)
    assert read(new) == [message for message in sent if message[:2] not in had]
    assert losses[-1] == f"bag_1.mcap: {len(had)} of its {len(had)} messages are lost"


@pytest.mark.parametrize(("total", "free"), [(100_000, 10**9), (10**9, 111_000)])
def test_oldest_files_go_beyond_the_limit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, total: int, free: int
) -> None:
    """The bag stays within the limit, and has its newest messages; its metadata list no other file.

    The limit is its own, or nine tenths of what was free at the start.

    Not even if there is room for messages, but none for the metadata without the oldest file.
    """
    directory, random, largest = tmp_path / "bag", Random(1), 0
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    bag, about = live_bag(directory, 5000, total), directory / "metadata.yaml"

    def write(seconds: range) -> None:
        nonlocal largest
        for second in seconds:
            write_second(bag, second, random.random())
            if about.exists():
                listed = re.findall(r"path: (bag_\d+.mcap)", about.read_text())
                assert listed and all((directory / name).exists() for name in listed)
            largest = max(largest, sum(path.stat().st_size for path in directory.glob("*.mcap")))

    write(range(2000))
    assert 90_000 < largest < 102_000  # the messages since the last flush can come on top
    assert not (directory / "bag_0.mcap").exists()
    with no_file_beyond(about.stat().st_size - 500):
        write(range(2000, 2300))
        assert "File too large" in bag.problem and not about.exists()
    write(range(2300, 3500))
    assert bag.problem == ""
    bag.close()
    stamps = [stamp for _, stamp, _ in read(directory)]
    assert stamps[-1] == LATE_NS + 3499 * 10**9
    assert {after - before for before, after in pairwise(stamps)} == {10**9}


def test_a_simulations_bag_without_room_for_its_metadata_is_whole(tmp_path: Path) -> None:
    writer = bag_writer(tmp_path / "bag")
    written = write_ticks(writer, 20)
    (tmp_path / "bag" / ".metadata.yaml.part").mkdir()
    with pytest.raises(IsADirectoryError):
        writer.close()
    writer.cut()
    assert writer.safe == 20 and messages_of(writer.path) == written


@pytest.mark.parametrize("room", [6000, 9000, 12_000])
def test_recording_that_fails_tries_again(tmp_path: Path, room: int) -> None:
    """Wherever the room ends: the rest is lost, and reported until something is safe."""
    bag, random = live_bag(tmp_path / "bag"), Random(1)
    values, second = [random.random() for _ in range(3000)], 0
    with no_file_beyond(room):
        while not bag.problem:
            write_second(bag, second, values[second])
            second += 1
    with no_file_beyond(50):  # it tries again in vain, and leaves nothing
        for later in range(second, second + 100):
            write_second(bag, later, values[later])
        assert bag.problem and len(list(bag.directory.iterdir())) == 1
        second += 100
    for later in range(second, 3000):
        write_second(bag, later, values[later])
    assert bag.problem == ""
    bag.close()
    restored = read(recover(tmp_path)[0])
    assert len(restored) >= 3000 - second - 60  # one wait
    assert set(restored) <= {
        (TOPICS[0], LATE_NS + second * 10**9, value) for second, value in enumerate(values)
    }


def test_a_single_topic_elsewhere_is_no_second_graph() -> None:
    names = {"/roof/level", "/pump/flow", "/s/roof/level"}
    assert find_namespace(names, ["/roof/level", "/pump/flow"], Path("bag")) == ""
