"""The writer of mcap files: byte for byte the files of the format's own library."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from itertools import count
from random import Random

import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.writer import Writer

from greenroof_ros.results.mcap import McapWriter

# One call of both writers: a schema, a channel, a message, or none for a flush.
Step = tuple[str, str, bytes] | tuple[str, str, int, dict[str, str]] \
    | tuple[int, int, bytes, int, int] | None


def ours(steps: list[Step]) -> bytes:
    """Write a file with the writer under test."""
    stream = BytesIO()
    writer = McapWriter(stream)
    types, topics = count(1), count(1)

    def add_schema(name: str, encoding: str, data: bytes) -> None:
        writer.add(Schema(next(types), data, encoding, name))

    def add_channel(topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> None:
        writer.add(Channel(next(topics), topic, encoding, metadata, schema))

    perform(steps, add_schema, add_channel, writer.add_message, writer.flush)
    writer.finish()
    return stream.getvalue()


def theirs(steps: list[Step]) -> bytes:
    """Write the same file with the library."""
    stream = BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2", library="greenroof_ros")
    perform(
        steps, writer.register_schema, writer.register_channel, writer.add_message, writer.flush
    )
    writer.finish()
    return stream.getvalue()


def perform(
    steps: list[Step], schema: Callable[..., object], channel: Callable[..., object],
    message: Callable[..., None], flush: Callable[[], None],
) -> None:
    for step in steps:
        if step is None:
            flush()
        else:
            {3: schema, 4: channel, 5: message}[len(step)](*step)


TOPICS: list[Step] = [
    ("std_msgs/msg/Float64", "ros2msg", b"float64 data\n"),
    ("/roof/level", "cdr", 1, {"offered_qos_profiles": "- depth: 1\n", "topic_type_hash": "RIHS"}),
    ("/never/sent", "cdr", 1, {}),
    ("/d\u00e9bit", "cdr", 0, {}),
]


@pytest.mark.parametrize("largest", [0, 8, 2000, 3 * 2**20])
def test_a_file_is_the_librarys(largest: int) -> None:
    """For any input: time 0, disorder, gaps, late topics, equal or huge messages, flushes."""
    random, steps = Random(largest), [*TOPICS, (1, 0, b"", 0, 0)]  # of the earliest time
    for number in range(1000 if largest < 2**20 else 12):
        if number % 7 == 6:
            steps.append(None)
        if number == 5:
            steps += [("later/msg/Type", "", b""), ("/later", "json", 2, {"b": "1", "a": "2"})]
        channel = random.choice((1, 3, 4) if number > 5 else (3, 1))
        size = random.randrange(largest + 1)
        steps.append((
            channel, random.randrange(2**63), random.randbytes(size) if number % 2 else bytes(size),
            random.randrange(2**63), random.randrange(2**32),
        ))
    content = ours(steps)
    assert content == theirs(steps)
    messages = sorted(
        (message.channel_id, message.log_time, message.data, message.publish_time, message.sequence)
        for _, _, message in make_reader(BytesIO(content), validate_crcs=True).iter_messages()
    )
    assert messages == sorted(step for step in steps if step is not None and len(step) == 5)


@pytest.mark.parametrize("steps", [[], [*TOPICS, None, None]])
def test_a_file_without_messages_is_the_librarys(steps: list[Step]) -> None:
    assert ours(steps) == theirs(steps)
