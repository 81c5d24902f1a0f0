"""The past of a value: no extreme is lost, memory is bounded, and a restart keeps it."""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from page_inputs import SECOND, START

from greenroof_ros.watch.history import (
    MAX_STRETCHES,
    STRETCH_NS,
    History,
    read_histories,
    write_histories,
)

WEEK_NS = 7 * 86_400 * SECOND


def ticks(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times a second apart, and values that are all different."""
    return START + SECOND * np.arange(count), np.random.default_rng(3).normal(size=count)


def filled(times: np.ndarray, values: np.ndarray) -> History:
    history = History()
    for time_ns, value in zip(times.tolist(), values.tolist(), strict=True):
        history.add(time_ns, value)
    return history


@pytest.mark.parametrize("decimals", [9, 0])
def test_every_extreme_is_in_the_line(decimals: int) -> None:
    """Of each stretch its lowest, highest and last value, and times that rise."""
    times, values = ticks(5000)
    values = values.round(decimals)
    history = filled(times, values)
    for stretch in (STRETCH_NS, 25 * STRETCH_NS):
        line = history.line(START, int(times[-1]), stretch, 600.0)
        assert np.all(np.diff([at for at, _ in line]) > 0)
        for number in np.unique(times // stretch):
            there = values[times // stretch == number]
            shown = [value for at, value in line if int(at * 1e9) // stretch == number]
            assert (min(shown), max(shown), shown[-1]) == (there.min(), there.max(), there[-1])


def test_what_is_unknown_is_a_gap_and_a_short_run_is_none() -> None:
    """Values every 10 s, in stretches of 20 s."""
    values = [0, 0, 0, 7, 0, 0, 5, math.nan, math.nan, 5]
    history = filled(START + SECOND * np.arange(0, 100, 10), np.array(values, float))
    line = history.line(START, START + 100 * SECOND, STRETCH_NS, 600.0)
    assert [(round(at - START / 1e9, 3), value) for at, value in line] == [
        (10, 0), (29.998, 0), (29.999, 7), (30, 7), (50, 0), (70, None), (90, 5),
    ]


def test_a_line_ends_at_its_last_value_before_a_gap() -> None:
    seconds = np.array([*range(0, 100, 10), 3615, 3625])
    history = filled(START + SECOND * seconds, np.full(len(seconds), 5.0))
    line = history.line(START, START + 2 * 3600 * SECOND, STRETCH_NS, 600.0)
    shown = [(round(at - START / 1e9, 3), value) for at, value in line]
    assert shown[-4:] == [(90, 5.0), (90.001, None), (3615, 5.0), (3625, 5.0)]


def test_a_line_stands_still_while_the_window_moves() -> None:
    """A chart is redrawn often: the past must not flicker."""
    times, values = ticks(20_000)
    history, stretch = filled(times[:18_000], values[:18_000]), 5 * STRETCH_NS
    before = history.line(int(times[8000]), int(times[17_999]), stretch, 600.0)
    for place in (18_000, 18_001):
        history.add(int(times[place]), float(values[place]))
    after = history.line(int(times[8002]), int(times[18_001]), stretch, 600.0)
    assert before[3:-3] == after[3:len(before) - 3]
    assert after[-1] == [times[18_001] / 1e9, values[18_001]]


def test_a_week_is_kept_and_memory_is_bounded() -> None:
    """Of three weeks with a value every 20 s, the last is kept."""
    times = START + STRETCH_NS * np.arange(3 * MAX_STRETCHES)
    history = filled(times, np.arange(3.0 * MAX_STRETCHES))
    assert history.rows.nbytes <= 48 * MAX_STRETCHES
    end = int(times[-1])
    line = history.line(end - 2 * WEEK_NS, end, STRETCH_NS, 600.0)
    assert [value for _, value in line] == list(range(2 * MAX_STRETCHES, 3 * MAX_STRETCHES))


# --- the file -------------------------------------------------------------------------------------


def test_a_restart_keeps_the_past(tmp_path: Path) -> None:
    """Except what is later than now, as after a clock that was set back; then it goes on."""
    file, (times, values) = tmp_path / "made" / "watch.npz", ticks(500)
    history = filled(times, values)
    for _ in range(2):  # it is replaced
        write_histories(file, {"roof": history.rows, "flow": History().rows})
    assert {path.name for path in file.parent.iterdir()} == {"watch.npz", "watch.lock"}
    assert read_histories(tmp_path / "none.npz", ["roof"], START) == {}
    read = read_histories(file, ["roof", "flow", "rain"], START + 400 * SECOND)
    assert read.keys() == {"roof", "flow"} and not len(read["flow"].rows)
    np.testing.assert_array_equal(read["roof"].rows, history.rows[:20])
    read["roof"].add(START + 401 * SECOND, 7.0)
    assert read["roof"].line(START, START + WEEK_NS, STRETCH_NS, 600.0)[-1][1] == 7.0


def _with(**content: object) -> bytes:
    """Return a file with this content, as NumPy writes it."""
    stream = BytesIO()
    np.savez(stream, **content)  # type: ignore[arg-type]
    return stream.getvalue()


ROWS = filled(*ticks(100)).rows
WRONG_TIMES, WRONG_VALUES = ROWS[::-1].copy(), ROWS.copy()
WRONG_VALUES["low"] = math.inf
WHOLE = _with(format=2, roof=ROWS)


@pytest.mark.parametrize("content", [
    b"", b"a site: 1\n", b"PK\x03\x04", bytes(5000), WHOLE[:len(WHOLE) // 2],
    WHOLE.replace(b"\x93NUMPY", b"\x93NUMPX"), _with(roof=ROWS), _with(format=1, roof=ROWS),
    _with(format=2, roof=np.arange(3.0)),
    _with(format=2, roof=ROWS[:4].reshape(2, 2)), _with(format=2, roof=WRONG_TIMES),
    _with(format=2, roof=WRONG_VALUES), _with(format=2, roof=np.array([{}], dtype=object)),
], ids=lambda content: f"{len(content)} bytes")
def test_a_damaged_or_foreign_file_is_refused(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "watch.npz"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"."):
        read_histories(file, ["roof"], START + WEEK_NS)


def test_any_damage_is_refused_or_leaves_plausible_rows(tmp_path: Path) -> None:
    """A bit that is flipped anywhere raises no other error."""
    file, chance = tmp_path / "watch.npz", np.random.default_rng(1)
    for _ in range(300):
        damaged = bytearray(WHOLE)
        damaged[chance.integers(len(damaged))] ^= 1 << chance.integers(8)
        file.write_bytes(damaged)
        try:
            read = read_histories(file, ["roof"], START + WEEK_NS)
        except ValueError:
            continue
        for history in read.values():
            assert np.all(np.diff(history.rows["ended"]) > 0)
