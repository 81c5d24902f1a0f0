"""The permit that bringup gives the pump node: what comes for one, and is none."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from greenroof_ros.graph.supervision import PERMIT_PIPE, PermitReader

LATE = "bringup has given no permit for 2 s"


@pytest.fixture
def pipe(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[PermitReader, int]]:
    """Return the pump node's end, and the one to write to."""
    ours, theirs = os.pipe()
    monkeypatch.setenv(PERMIT_PIPE, str(ours))
    yield PermitReader(), theirs
    os.close(ours)
    os.close(theirs)


def test_a_permit_lapses(pipe: tuple[PermitReader, int]) -> None:
    """After two seconds, or with its reason; before the first there is none."""
    reader, end = pipe
    assert reader.missing(100.0) == "bringup has given no permit yet"
    os.write(end, b'{"inhibit": "", "at": 100.0}\n')
    assert [reader.missing(at) for at in (100.0, 101.9, 102.1)] == ["", "", LATE]
    os.write(end, b'{"inhibit": "weather is silent", "at": 103.0}\n')
    assert reader.missing(103.1) == "weather is silent"


@pytest.mark.parametrize("at", ["1e9", "NaN", "Infinity", "-Infinity", "-1.0"])
def test_what_is_of_no_time_is_no_permit(pipe: tuple[PermitReader, int], at: str) -> None:
    """As of a bringup with another clock, which then hangs: its permit would never lapse."""
    reader, end = pipe
    os.write(end, f'{{"inhibit": "", "at": {at}}}\n'.encode())
    assert [reader.missing(now) for now in (100.0, 3700.0)] == [LATE, LATE]


@pytest.mark.parametrize("line", ["", "{}", "[]", "null", '{"at": 100.0}', '{"inhibit": ""}', "x"])
def test_what_says_something_else_is_no_permit(pipe: tuple[PermitReader, int], line: str) -> None:
    """As of a bringup of another version."""
    reader, end = pipe
    os.write(end, f"{line}\n".encode())
    assert reader.missing(100.0) == "bringup has given no permit yet"
