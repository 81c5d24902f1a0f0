"""What a recorder that was killed had not yet written."""

from __future__ import annotations

from pathlib import Path

from mcap.exceptions import McapError
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from greenroof_ros.recording.bag_writer import FLUSH_S, bag_files

# What a recorder may lose (s): what came since its last flush, and a flush that was under way.
BOUND_S = FLUSH_S + 1.0


def newest_file(bag: Path) -> Path | None:
    """Return the file of a live bag that is being written."""
    files = bag_files(bag)
    return files[-1] if files else None


def last_message(file: Path) -> float:
    """Return when the last whole message of a file came (s since 1970); it need not be closed."""
    last = 0
    try:
        with file.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True).records:
                found = breakup_chunk(record) if isinstance(record, Chunk) else [record]
                for one in found:
                    if isinstance(one, Message):
                        last = max(last, one.log_time)
    except (McapError, EOFError):
        pass  # where it was cut
    return last / 1e9
