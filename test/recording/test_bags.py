"""Bags and trajectories: what is written comes back, by this package's readers and by others."""

from __future__ import annotations

import resource
import struct
from datetime import datetime
from pathlib import Path
from random import Random

import numpy as np
import pytest
from mcap.reader import make_reader
from paper import PAPER_SITE

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.interface import read_topics
from greenroof_ros.recording.bag_reader import load_bag
from greenroof_ros.recording.bag_writer import BagWriter
from greenroof_ros.recording.damaged_bag import read_ticks
from greenroof_ros.recording.results_table import parameter_columns, row_parameters
from greenroof_ros.recording.trajectory import Trajectory, read_parquet

START = datetime.fromisoformat("2021-07-07T02:00-05:00")
START_NS = 1625641200 * 10**9  # 07:00 UTC, by date -d
TOPICS = (
    "/roof/level", "/cistern/level", "/pump/command", "/pump/flow", "/weather/precipitation"
)


def write_bag(directory: Path, ticks: int) -> list[dict[str, float]]:
    """Write a bag of values that no two ticks or topics share; return them."""
    interface = read_topics()
    writer = BagWriter(directory, [interface[name] for name in TOPICS])
    rows = []
    for tick in range(ticks):
        values = dict(zip(
            TOPICS, (0.03 + tick * 1e-5, 2.3 - tick * 1e-4, 0.5 + tick / 1e4, 4e-3 + tick * 1e-7,
                     tick * 1e-8), strict=True,
        ))
        # CDR: little-endian header, then the number.
        messages = [b"\x00\x01\x00\x00" + struct.pack("<d", value) for value in values.values()]
        writer.write_tick(START_NS + tick * 10**9, messages)
        rows.append(values)
    writer.close()
    return rows


def test_a_bag_comes_back(tmp_path: Path) -> None:
    """Levels as volumes over the bottom areas of Table I, everything else as it was."""
    rows = write_bag(tmp_path / "bag", 40)
    zone = START.tzinfo
    assert zone is not None
    read, notes = load_bag(tmp_path / "bag", PAPER_SITE, zone, own=False)
    assert read.start == START
    assert read.time.tolist() == list(range(40))
    assert read.roof.tolist() == [row["/roof/level"] * 68.8 for row in rows]
    assert read.cistern.tolist() == [row["/cistern/level"] * 25 for row in rows]
    assert read.command.tolist() == [row["/pump/command"] for row in rows]
    assert read.pump_flow.tolist() == [row["/pump/flow"] for row in rows]
    assert read.precipitation.tolist() == [row["/weather/precipitation"] for row in rows]
    assert not read.drainage.any()
    assert any("/roof/drainage is not in the bag" in str(note) for note in notes)


def test_a_bag_is_read_by_mcap(tmp_path: Path) -> None:
    """Topics, types, times and sequence, by the format's own library."""
    write_bag(tmp_path / "bag", 3)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        found = [
            (channel.topic, schema.name, message.log_time, message.sequence)
            for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages()
        ]
    assert sorted(found) == sorted(
        (topic, "std_msgs/msg/Float64", START_NS + tick * 10**9, tick)
        for tick in range(3) for topic in TOPICS
    )


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_bag_that_was_cut_keeps_its_whole_ticks(tmp_path: Path, share: float) -> None:
    """From the first on, without a gap, and no half tick."""
    rows = write_bag(tmp_path / "bag", 200)
    file = tmp_path / "bag" / "bag_0.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    ticks = list(read_ticks(file))
    assert 0 < len(ticks) < 200
    for tick, ((channels, time_ns, messages), row) in enumerate(zip(ticks, rows, strict=False)):
        assert time_ns == START_NS + tick * 10**9
        values = {
            channel.topic: struct.unpack("<d", message[4:])[0]
            for channel, message in zip(channels, messages, strict=True)
        }
        assert values == row


@pytest.mark.parametrize("room", range(20_000, 24_000, 400))
def test_a_file_that_cannot_grow_keeps_what_was_safe(tmp_path: Path, room: int) -> None:
    """Wherever in its chunks the room ends: as many ticks as the writer says, and no more."""
    interface = read_topics()
    writer = BagWriter(tmp_path / "bag", [interface[name] for name in TOPICS])
    random = Random(1)

    def write() -> None:
        for tick in range(2000):
            messages = [struct.pack("<Id", 256, random.random()) for _ in TOPICS]
            writer.write_tick(START_NS + tick * 10**9, messages)

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(OSError, match="File too large"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert writer.safe > 0
    assert len(list(read_ticks(tmp_path / "bag" / "bag_0.mcap"))) == writer.safe


def test_a_trajectory_keeps_every_bit(tmp_path: Path) -> None:
    """Numbers that no decimal of 15 digits holds."""
    random = np.random.default_rng(1)
    names = (
        "time", "cistern", "roof", "precipitation", "evapotranspiration", "command", "pump_flow",
        "outflow", "drainage", "frost",
    )
    columns = {name: random.random(50) * 10.0 ** random.integers(-300, 300) for name in names}
    (tmp_path / "run.parquet").write_bytes(Trajectory(start=START, **columns).to_parquet())
    read = read_parquet(tmp_path / "run.parquet")
    assert read.start == START
    for name, values in columns.items():
        assert getattr(read, name).tobytes() == values.tobytes(), name


def test_a_file_that_is_no_trajectory(tmp_path: Path) -> None:
    """It is named, with what to do."""
    (tmp_path / "run.parquet").write_bytes(b"PAR1")
    with pytest.raises(ConfigurationError, match=r"run\.parquet: is empty, cut short or no"):
        read_parquet(tmp_path / "run.parquet")


def test_parameters_are_columns_of_their_own() -> None:
    """A parameter named as another column is not mistaken for it."""
    row = {"hours": "12", **parameter_columns({"hours": "3", "gain": "20"})}
    assert row == {"hours": "12", "parameter:hours": "3", "parameter:gain": "20"}
    assert row_parameters(row) == {"hours": "3", "gain": "20"}
