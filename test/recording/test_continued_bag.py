"""Bags in several files: closed where their writer was killed, and gone on with."""

from __future__ import annotations

import struct
from pathlib import Path
from random import Random

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.recording.bag_reader import count_ticks
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.continued_bag import continue_bag
from greenroof_ros.recording.cut_file import close_file
from greenroof_ros.recover import recover

START_NS = 1625641200 * 10**9
TOPICS = [read_topics()[name] for name in ("/clock", "/pump/command", "/weather/frost")]


def write(writer: BagWriter, ticks: range) -> None:
    """Write ticks whose values say which they are."""
    for tick in ticks:
        writer.write_tick(START_NS + tick * 10**9, [
            b"\x00\x01\x00\x00" + struct.pack("<d", tick + place / 10)
            for place in range(len(TOPICS))
        ])


def values(bag: Path) -> dict[str, list[float]]:
    """Return the values of each topic, by rosbags."""
    found: dict[str, list[float]] = {}
    with AnyReader([bag]) as reader:
        for connection, time_ns, data in reader.messages():
            value = struct.unpack_from("<d", data, 4)[0]
            assert time_ns == START_NS + int(value) * 10**9
            found.setdefault(connection.topic, []).append(value)
    return found


def expected(ticks: int) -> dict[str, list[float]]:
    return {
        topic.name: [tick + place / 10 for tick in range(ticks)]
        for place, topic in enumerate(TOPICS)
    }


def killed(directory: Path, ticks: int) -> Path:
    """Leave a bag as a killed writer does: what was flushed, every 16 ticks, and no end."""
    writer = BagWriter(directory, TOPICS)
    write(writer, range(ticks))
    return directory / f"{directory.name}_0.mcap"


def test_a_file_cut_anywhere_is_closed_behind_its_last_whole_tick(tmp_path: Path) -> None:
    """Whole chunks of 16 ticks are left, and the format's library is content."""
    whole = killed(tmp_path / "bag", 100).read_bytes()
    chance = Random(5)
    found = set()
    for size in [len(whole), *(chance.randrange(8, len(whole)) for _ in range(100))]:
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(whole[:size])
        before = cut.read_bytes()
        closed = close_file(cut)
        if closed is None:
            assert cut.read_bytes() == before
            found.add(0)
            continue
        found.add(closed.ticks)
        assert closed.ticks % 16 == 0
        assert (closed.first_ns, closed.last_ns) == (
            START_NS, START_NS + (closed.ticks - 1) * 10**9
        )
        with cut.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            read = [
                (channel.topic, message.sequence, struct.unpack_from("<d", message.data, 4)[0])
                for _, channel, message in reader.iter_messages()
            ]
        assert read == [
            (topic.name, tick, tick + place / 10)
            for tick in range(closed.ticks) for place, topic in enumerate(TOPICS)
        ]
        assert close_file(cut) == closed  # closed already
    assert found == {0, 16, 32, 48, 64, 80, 96}


def test_a_bag_is_gone_on_with(tmp_path: Path) -> None:
    """Killed after 100 ticks, of which 96 are safe, again after 10 more, and then closed."""
    bag = tmp_path / "bag"
    killed(bag, 100)
    second = continue_bag(bag, TOPICS)
    assert second.ticks == second.safe == 96
    assert count_ticks(bag) is None  # not closed
    write(second, range(96, 106))  # nothing of it is safe
    third = continue_bag(bag, TOPICS)
    assert third.ticks == 96
    write(third, range(96, 130))
    third.close()
    assert values(bag) == expected(130)
    assert count_ticks(bag) == 130
    information = yaml.safe_load((bag / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]
    assert information["relative_file_paths"] == ["bag_0.mcap", "bag_1.mcap"]
    assert [file["message_count"] for file in information["files"]] == [96 * 3, 34 * 3]
    assert information["message_count"] == 130 * 3
    assert information["duration"]["nanoseconds"] == 129 * 10**9
    # A recorder that was killed when it had only to close the bag: no empty file is added.
    continue_bag(bag, TOPICS).close()
    assert sorted(file.name for file in bag.iterdir()) == [
        "bag_0.mcap", "bag_1.mcap", "metadata.yaml"
    ]
    assert values(bag) == expected(130)


def test_recovery_of_several_files(tmp_path: Path) -> None:
    """The second was cut: what is whole of both is in one."""
    bag = tmp_path / "bag"
    killed(bag, 50)
    write(continue_bag(bag, TOPICS), range(48, 100))
    target, amount = recover(bag, tmp_path / "whole")
    assert amount == "96 ticks"  # 48, and three times 16
    assert values(target) == expected(96)


def test_a_bag_of_other_topics_is_not_gone_on_with(tmp_path: Path) -> None:
    """It would be no bag of ticks."""
    killed(tmp_path / "bag", 20)
    with pytest.raises(ConfigurationError, match="only a bag of the same topics"):
        continue_bag(tmp_path / "bag", TOPICS[:2])
