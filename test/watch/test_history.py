"""The past of a value: no extreme is lost, memory is bounded, and a restart keeps it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from page_inputs import SECOND, START

from greenroof_ros.watch.lines import (
    STRETCH_NS,
    History,
    read_histories,
    write_histories,
)


def filled(seconds: np.ndarray, values: np.ndarray) -> History:
    history = History()
    for second, value in zip(seconds.tolist(), values.tolist(), strict=True):
        history.add(START + second * SECOND, value)
    return history


def shown(history: History, stretch: int = STRETCH_NS) -> list[tuple[float, float | None]]:
    line = history.line(START, START + 10**17, stretch, 600.0)
    return [(round(at - START / 1e9, 3), value) for at, value in line]


def test_every_extreme_is_in_the_line() -> None:
    """Of each stretch its lowest, highest and last value, and times that rise."""
    seconds, values = np.arange(5000), np.random.default_rng(3).normal(size=5000)
    history = filled(seconds, values)
    for stretch in (20, 400):
        line = shown(history, stretch * SECOND)
        assert np.all(np.diff([at for at, _ in line]) > 0)
        for number in range(5000 // stretch):
            there = values[seconds // stretch == number]
            seen = [value for at, value in line if int(at) // stretch == number]
            assert (min(seen), max(seen), seen[-1]) == (there.min(), there.max(), there[-1])


def test_what_is_unknown_is_a_gap_and_a_short_run_is_none() -> None:
    """Values every 10 s, in stretches of 20 s; then none for an hour, and a clock set back."""
    values = [0, 0, 0, 7, 0, 0, 5, math.nan, math.nan, 5]
    history = filled(np.array([*range(0, 100, 10), 3615, 3625]), np.array([*values, 5, 5], float))
    assert shown(history) == [
        (10, 0), (29.998, 0), (29.999, 7), (30, 7), (50, 0), (70, None), (90, 5), (90.001, None),
        (3615, 5), (3625, 5),
    ]
    history.add(START + 100 * SECOND, 3.0)
    assert shown(history)[-2:] == [(90, 5), (100, 3)]


def test_the_file_is_read_as_it_was_written_and_damage_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("greenroof_ros.watch.lines.print_line", said.append)
    file = tmp_path / "made" / "watch.npz"
    rows = filled(np.arange(100), np.arange(100.0)).rows
    assert read_histories(file) == {}
    write_histories(file, {"roof": rows[::-1].copy()})  # times that fall
    contents = [file.read_bytes(), b"", b"a site: 1\n", b"PK\x03\x04"]
    write_histories(file, {"roof": rows})
    np.testing.assert_array_equal(read_histories(file)["roof"].rows, rows)
    for number, content in enumerate((*contents, file.read_bytes()[:-50]), start=1):
        file.write_bytes(content)
        assert read_histories(file) == {}
        assert len(said) == number
