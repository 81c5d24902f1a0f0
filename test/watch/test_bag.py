"""A bag that is followed while it is written, cut, damaged, removed and replaced."""

from __future__ import annotations

import os
import struct
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import numpy as np
import pytest

from greenroof_ros.common.interface import read_topics, recorded_topics
from greenroof_ros.recording.bag_writer import FLUSH_S, BagWriter, LiveBag
from greenroof_ros.watch import wire
from greenroof_ros.watch.bag import Batch, GrowingBag

START_NS = 1_625_641_200 * 10**9
DAY_NS = 86_400 * 10**9


def number(value: float) -> bytes:
    """Return a Float64 in CDR."""
    return struct.pack("<Id", 256, value)


def row(values: Sequence[float]) -> bytes:
    """Return a Float64MultiArray without layout in CDR."""
    return struct.pack(f"<IIII4x{len(values)}d", 256, 0, 0, len(values), *values)


class Run:
    """A bag as a simulation's recorder writes it, with arbitrary values.

    Attributes:
        numbers: the numbers written, by topic, each with its time.
    """

    def __init__(self, bag: Path, namespace: str = "", start_ns: int = START_NS) -> None:
        self.numbers: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
        self.file = bag / f"{bag.name}_0.mcap"
        self._topics = recorded_topics({"/controller/cost": "cost"})
        self._start_ns = start_ns
        self._random = Random(start_ns)
        self.writer = BagWriter(
            bag, [replace(topic, name=namespace + topic.name) for topic in self._topics]
        )

    def ticks(self, count: int) -> None:
        for _ in range(count):
            tick = self.writer.written
            time_ns = self._start_ns + tick * 10**9
            messages = []
            for topic in self._topics:
                if topic.type.endswith("Clock"):
                    messages.append(struct.pack("<Iii", 256, time_ns // 10**9, 0))
                elif topic.type.endswith("MultiArray"):
                    messages.append(row([float(tick)] * 10))
                else:
                    value = self._random.random()
                    self.numbers[topic.name].append((time_ns, value))
                    messages.append(number(value))
            self.writer.write_tick(time_ns, messages)


def finished_run(bag: Path, ticks: int, start_ns: int = START_NS) -> Run:
    run = Run(bag, start_ns=start_ns)
    run.ticks(ticks)
    run.writer.close()
    return run


class Reader:
    """Collects what was read."""

    def __init__(self, bag: Path, namespace: str | None = None) -> None:
        self._bag = GrowingBag(bag, namespace)
        self.recorded = Batch()
        self.numbers: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
        self.messages: dict[tuple[str, int], tuple[int, bytes]] = {}

    def read(self) -> None:
        """Read everything available."""
        while True:
            self.recorded = batch = self._bag.read()
            for topic, times, values in batch.numbers:
                assert len(times) == len(values) > 0
                self.numbers[topic] += zip(times.tolist(), values.tolist(), strict=True)
            self.messages |= batch.messages
            if not batch.more:
                return


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return finished_run(tmp_path_factory.mktemp("finished") / "bag", 500)


def test_each_byte_is_read_once(finished: Run, tmp_path: Path) -> None:
    """A file that grows in pieces of any length gives each of its messages once, in order."""
    content = finished.file.read_bytes()
    random = Random(2)
    bag = tmp_path / "bag"
    bag.mkdir()
    reader = Reader(bag)
    reader.read()
    assert "no recording" in reader.recorded.problem
    at = 0
    with (bag / "bag_0.mcap").open("wb", buffering=0) as stream:
        while at < len(content):
            length = random.choice((1, 5, 60, 700, 9000))
            stream.write(content[at : at + length])
            at += length
            reader.read()
            assert not reader.recorded.problem
    assert reader.numbers == finished.numbers
    assert reader.recorded.newest_ns == START_NS + 499 * 10**9
    time_ns, message = reader.messages["/forecast/precipitation", 0]
    assert time_ns == START_NS + 499 * 10**9
    rows = wire.rows(message)
    assert rows is not None and rows[0].tolist() == [499.0] * 10


def test_what_the_recorder_has_flushed_is_there(tmp_path: Path) -> None:
    """Every 16 ticks, also in a namespace."""
    run = Run(tmp_path / "bag", "/site1")
    readers = [Reader(tmp_path / "bag", namespace) for namespace in (None, "/site1")]
    other = Reader(tmp_path / "bag", "")
    for ticks in (16, 1, 40):
        run.ticks(ticks)
        for reader in readers:
            reader.read()
            assert len(reader.numbers["/roof/level"]) == run.writer.safe
    other.read()
    assert not other.numbers
    run.writer.close()


def test_damage_is_reported_and_the_rest_is_read(finished: Run, tmp_path: Path) -> None:
    """Any bytes of the file can be wrong: nothing raises, and other chunks are read."""
    content = finished.file.read_bytes()
    expected = {topic: dict(pairs) for topic, pairs in finished.numbers.items()}
    random = Random(3)
    most = 0
    for number in range(12):
        bag = tmp_path / f"{number}"
        bag.mkdir()
        changed = bytearray(content)
        place = random.randrange(len(changed) // 2)
        changed[place : place + 4] = random.randbytes(4)
        (bag / "bag_0.mcap").write_bytes(changed)
        reader = Reader(bag, "")
        reader.read()
        if reader.recorded.problem:
            assert "damaged" in reader.recorded.problem
            most = max(most, len(reader.numbers["/roof/level"]))
        for topic, pairs in reader.numbers.items():
            # Each chunk has a checksum, so no wrong value is read.
            assert all(expected[topic][time_ns] == value for time_ns, value in pairs)
    assert most >= 480  # a damaged chunk loses only its 16 ticks


def test_a_file_that_ends_in_zeros_keeps_what_was_before(finished: Run, tmp_path: Path) -> None:
    """As after a power failure; the next file of the bag is read as well."""
    bag = tmp_path / "bag"
    bag.mkdir()
    content = finished.file.read_bytes()
    half = len(content) // 2
    (bag / "bag_0.mcap").write_bytes(content[:half] + bytes(len(content) - half))
    later = finished_run(tmp_path / "later", 20, START_NS + 500 * 10**9)
    later.file.rename(bag / "bag_1.mcap")
    reader = Reader(bag, "")
    reader.read()
    assert "damaged" in reader.recorded.problem
    for topic, pairs in finished.numbers.items():
        kept = len(reader.numbers[topic]) - 20
        assert reader.numbers[topic] == [*pairs[:kept], *later.numbers[topic]]
        assert kept > 200


def test_files_that_are_none(tmp_path: Path) -> None:
    """An empty file is a beginning; text, a directory and a record of any length are reported."""
    for name, content in (
        ("empty", b""), ("begun", b"\x89MCAP0\r\n"), ("text", b"hello, this is text"),
        ("long", b"\x89MCAP0\r\n\x06" + b"\xff" * 8), ("odd", b"\x89MCAP0\r\n\x00" + bytes(80)),
    ):
        bag = tmp_path / name
        bag.mkdir()
        (bag / "x_0.mcap").write_bytes(content)
        reader = Reader(bag)
        reader.read()
        reader.read()
        assert bool(reader.recorded.problem) == (name not in ("empty", "begun")), name
    (tmp_path / "directory" / "x_0.mcap").mkdir(parents=True)
    reader = Reader(tmp_path / "directory")
    reader.read()
    assert "cannot be read" in reader.recorded.problem


def test_another_bag_in_its_place(tmp_path: Path) -> None:
    """The bag is removed and made again, or becomes shorter than what was read."""
    bag = tmp_path / "bag"
    finished_run(bag, 100)
    reader = Reader(bag)
    reader.read()
    # The old file is kept under another name, so that its inode is not reused.
    bag.rename(tmp_path / "kept")
    reader.read()
    assert not reader.recorded.replaced
    assert "no recording" in reader.recorded.problem
    finished_run(bag, 200, START_NS - DAY_NS)
    reader.read()
    assert reader.recorded.replaced
    other = Reader(tmp_path / "kept")
    other.read()
    os.truncate(tmp_path / "kept" / "bag_0.mcap", 5000)
    other.read()
    assert other.recorded.replaced


def live_bag(directory: Path) -> LiveBag:
    interface = read_topics()
    topics = [interface[name] for name in ("/roof/level", "/pump/state", "/diagnostics")]
    return LiveBag(directory, topics, file_bytes=10**7, total_bytes=10**9)


def test_a_live_bag(tmp_path: Path) -> None:
    """Files by the day; the past week is read, and an oldest file may disappear."""
    bag = live_bag(tmp_path / "bag")
    now = 0.0
    text = struct.pack("<II4s", 256, 4, b"off\0")
    for day in range(12):
        for second in range(20):
            time_ns = START_NS + day * DAY_NS + second * 10**9
            bag.write("/roof/level", time_ns, number(day + second / 100), now)
            bag.write("/diagnostics", time_ns, bytes(500), now)
        bag.write("/pump/state", time_ns, text, now)
    now += FLUSH_S + 1
    bag.flush_if_due(now)
    for day in range(12):
        written = (START_NS + (day + 1) * DAY_NS) / 1e9
        os.utime(tmp_path / "bag" / f"bag_{day}.mcap", (written, written))
    reader = Reader(tmp_path / "bag", "")
    reader.read()
    assert {round(value) for _, value in reader.numbers["/roof/level"]} == set(range(5, 12))
    assert reader.messages["/pump/state", time_ns] == (time_ns, text)
    (tmp_path / "bag" / "bag_3.mcap").unlink()
    (tmp_path / "bag" / "bag_0.mcap").unlink()
    bag.write("/roof/level", time_ns + 10**9, number(99.0), now)
    reader.read()
    assert reader.numbers["/roof/level"][-1] != (time_ns + 10**9, 99.0)  # not yet flushed
    now += FLUSH_S + 1
    bag.flush_if_due(now)
    reader.read()
    assert reader.numbers["/roof/level"][-1] == (time_ns + 10**9, 99.0)
    times = [time_ns for time_ns, _ in reader.numbers["/roof/level"]]
    assert times == sorted(set(times))
    assert not reader.recorded.problem
    bag.close()


def test_much_is_read_in_pieces(tmp_path: Path) -> None:
    """No batch holds all of a long run, and the progress is reported."""
    bag = live_bag(tmp_path / "long")
    values = np.random.default_rng(1).random(20_000)
    for tick, value in enumerate(values):
        bag.write("/roof/level", START_NS + tick * 10**6, number(value), 0.0)
        if tick % 100 == 0:  # incompressible bytes, 20 MB in all
            bag.write("/diagnostics", START_NS + tick * 10**6, os.urandom(100_000), 0.0)
    bag.close()
    reader = GrowingBag(tmp_path / "long", "")
    notes: set[str] = set()
    batches = []
    while True:
        batch = reader.read()
        notes.add(batch.progress)
        batches.append(np.concatenate([np.empty(0), *(values for *_, values in batch.numbers)]))
        if not batch.more:
            break
    assert np.array_equal(np.concatenate(batches), values)
    assert max(map(len, batches)) < len(values) / 4
    assert any(note.startswith("The recording is being read: ") for note in notes)
    assert batch.progress == ""
