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


def in_plain_python(
    times: np.ndarray, values: np.ndarray, stretch: int, steps: bool
) -> list[list[float]]:
    """Return of each stretch (ns) the time of its maximum change or its end (s), and its values.

    After them is the last value.
    """
    rows: dict[int, list[float]] = {}
    maximum, before = {times[0] // stretch: math.inf}, values[0]
    for at, value in zip(times.tolist(), values.tolist(), strict=True):
        key, change = at // stretch, abs(value - before)
        row = rows.setdefault(key, [at / 1e9, value, value, value])
        time = at / 1e9 if not steps or change > maximum.get(key, -1.0) else row[0]
        rows[key] = [time, min(row[1], value), max(row[2], value), value]
        maximum[key], before = max(change, maximum.get(key, -1.0)), value
    last = [times[-1] / 1e9, *[values[-1]] * 3]
    stretches = list(rows.values())
    return [*stretches, *([last] if last[0] > stretches[-1][0] else [])]


@pytest.mark.parametrize("decimals", [9, 0])
def test_every_extreme_is_in_the_rows(decimals: int) -> None:
    """Also if a value lasts for long, so that many changes of a stretch are equal."""
    times, values = ticks(5000)
    values = values.round(decimals)
    for count in (3, 1207, 5000):
        known = times[:count], values[:count]
        history = filled(*known)
        for stretch, steps in ((STRETCH_NS, False), (STRETCH_NS, True), (25 * STRETCH_NS, True)):
            rows = history.window(START, int(known[0][-1]), stretch, steps=steps)
            assert rows == in_plain_python(*known, stretch, steps)


def test_a_line_goes_to_its_last_value_before_a_gap() -> None:
    """Also if that has held for some seconds; stretches of 20 s that follow each other go on."""
    seconds = np.array([*range(0, 100, 10), 3615, 3625])
    history = filled(START + SECOND * seconds, np.full(len(seconds), 5.0))
    for steps, at in ((True, [0, 20, 40, 60, 80, 90]), (False, [10, 30, 50, 70, 90])):
        rows = history.window(START, START + 2 * 3600 * SECOND, STRETCH_NS, steps=steps)
        assert [row[0] - START / 1e9 for row in rows] == [*at, 3615, 3625]


def test_what_is_unknown_is_a_gap_from_when_it_became_unknown() -> None:
    values = np.full(100, 5.0)
    values[31:73] = math.nan
    values[85] = math.nan  # a stretch that is known again by its end
    history = filled(START + SECOND * np.arange(100), values)
    nothing, known = [None, None, None], [5.0, 5.0, 5.0]
    rows = history.window(START, START + 100 * SECOND, STRETCH_NS, steps=True)
    assert [[row[0] - START / 1e9, *row[1:]] for row in rows] == [
        [0, *known], [31, *nothing], [40, *nothing], [73, *known], [85, *known], [99, *known],
    ]


def test_rows_stand_still_while_the_window_moves() -> None:
    """A chart is redrawn every 2 s: the past must not flicker."""
    times, values = ticks(20_000)
    history, stretch = filled(times[:18_000], values[:18_000]), 5 * STRETCH_NS
    before = history.window(int(times[8000]), int(times[17_999]), stretch, steps=False)
    for place in (18_000, 18_001):
        history.add(int(times[place]), float(values[place]))
    after = history.window(int(times[8002]), int(times[18_001]), stretch, steps=False)
    assert before[1:-1] == after[1:-2]
    assert after[-1] == [times[18_001] / 1e9, *sorted(values[18_000:18_002]), values[18_001]]


def test_a_week_is_kept_and_memory_is_bounded() -> None:
    """Of three weeks with a value every 20 s, the last is kept."""
    times = START + STRETCH_NS * np.arange(3 * MAX_STRETCHES)
    history = filled(times, np.arange(3.0 * MAX_STRETCHES))
    assert history.rows.nbytes <= 48 * MAX_STRETCHES
    end = int(times[-1])
    rows = history.window(end - 2 * WEEK_NS, end, STRETCH_NS, steps=False)
    assert [row[3] for row in rows] == list(range(2 * MAX_STRETCHES, 3 * MAX_STRETCHES))


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
    assert read["roof"].window(START, START + WEEK_NS, STRETCH_NS, steps=False)[-1][3] == 7.0


def _with(**content: object) -> bytes:
    """Return a file with this content, as NumPy writes it."""
    stream = BytesIO()
    np.savez(stream, **content)  # type: ignore[arg-type]
    return stream.getvalue()


ROWS = filled(*ticks(100)).rows
WRONG_TIMES, WRONG_VALUES = ROWS[::-1].copy(), ROWS.copy()
WRONG_VALUES["low"] = math.inf
WHOLE = _with(format=1, roof=ROWS)


@pytest.mark.parametrize("content", [
    b"", b"a site: 1\n", b"PK\x03\x04", bytes(5000), WHOLE[:len(WHOLE) // 2],
    WHOLE.replace(b"\x93NUMPY", b"\x93NUMPX"), _with(roof=ROWS), _with(format=2, roof=ROWS),
    _with(format=1, roof=np.arange(3.0)),
    _with(format=1, roof=ROWS[:4].reshape(2, 2)), _with(format=1, roof=WRONG_TIMES),
    _with(format=1, roof=WRONG_VALUES), _with(format=1, roof=np.array([{}], dtype=object)),
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
