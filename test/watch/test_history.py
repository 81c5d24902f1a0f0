"""The past of a value: no extreme is lost, and memory is bounded."""

from __future__ import annotations

import random

import numpy as np
import pytest
from page_inputs import SECOND, START

from greenroof_ros.watch.history import MOST_STRETCHES, STRETCH_NS, Gaps, History


def ticks(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times a second apart, and values that are all different."""
    return START + SECOND * np.arange(count), np.random.default_rng(3).normal(size=count)


def in_plain_python(
    times: np.ndarray, values: np.ndarray, stretch: int, steps: bool
) -> list[list[float]]:
    """Return of each stretch (ns) the time of its maximum change or its end (s), and its values.

    Before and after them are the first and the last value.
    """
    rows: dict[int, list[float]] = {}
    maximum, before = {}, values[0]
    for at, value in zip(times.tolist(), values.tolist(), strict=True):
        key, change = at // stretch, abs(value - before)
        row = rows.setdefault(key, [at / 1e9, value, value, value])
        time = at / 1e9 if not steps or change > maximum.get(key, -1.0) else row[0]
        rows[key] = [time, min(row[1], value), max(row[2], value), value]
        maximum[key], before = max(change, maximum.get(key, -1.0)), value
    first, last = ([times[i] / 1e9, *[values[i]] * 3] for i in (0, -1))
    stretches = list(rows.values())
    return [
        *([first] if first[0] < stretches[0][0] else []), *stretches,
        *([last] if last[0] > stretches[-1][0] else []),
    ]


@pytest.mark.parametrize("steps", [False, True])
@pytest.mark.parametrize(("count", "batch", "stretch"), [
    *((5000, batch, STRETCH_NS) for batch in (1, 333)),
    (200_000, 200_000, 25 * STRETCH_NS),  # in 400 points they are 500 s each
])
@pytest.mark.parametrize("decimals", [9, 0])
def test_batches_of_any_size_give_every_extreme(
    count: int, batch: int, stretch: int, decimals: int, steps: bool
) -> None:
    """In few rows, however wide the window is, and however long a value lasts."""
    times, values = ticks(count)
    values = values.round(decimals)
    history = History()
    for first in range(0, count, batch):
        history.add(times[first : first + batch], values[first : first + batch])
    rows = history.window(int(times[0]), int(times[-1]), 400, steps=steps)
    assert rows == in_plain_python(times, values, stretch, steps)
    assert len(rows) <= 403


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("points", [400, 2])
def test_a_step_is_where_it_happened(points: int, noise: float) -> None:
    """It stays there while values go on, in stretches of 20 s, or of 10 min in two points.

    The newest values are only received; those before them are still on their way.
    """
    history, ran = History(), 487  # s: within a stretch of either length
    times = START + SECOND * np.arange(1200)
    values = noise * np.random.default_rng(5).random(1200)
    values[:ran] += 200.0
    for first in range(0, 1200, 7):
        for at, value in zip(times[first : first + 7], values[first : first + 7], strict=False):
            history.add_ahead(int(at), float(value))
        if first >= 21:
            history.add(times[first - 21 : first - 14], values[first - 21 : first - 14])
            rows = history.window(int(times[0]), int(times[-1]), points, steps=True)
            end = min(first + 6, 1199)
            assert [rows[0][::3], rows[-1][::3]] == [
                [times[at] / 1e9, values[at]] for at in (0, end)
            ]
            stops = [row[0] for row, before in zip(rows[1:], rows, strict=False)
                     if row[3] < before[3] - 100]
            assert stops == ([times[ran] / 1e9] if end >= ran else [])


def test_a_line_goes_to_its_last_value_before_a_gap() -> None:
    """Also if that has held for some seconds; stretches of 20 s that follow each other go on."""
    history = History()
    seconds = np.array([*range(0, 100, 10), 3615, 3625])
    history.add(START + SECOND * seconds, np.full(len(seconds), 5.0))
    for steps, at in ((True, [0, 20, 40, 60, 80, 90]), (False, [0, 10, 30, 50, 70, 90])):
        rows = history.window(START, START + 2 * 3600 * SECOND, 400, steps=steps)
        assert [row[0] - START / 1e9 for row in rows] == [*at, 3615, 3625]


def test_rows_stand_still_while_the_window_moves() -> None:
    """A chart is redrawn every 2 s: the past must not flicker."""
    times, values = ticks(100_000)
    history = History()
    history.add(times[:90_000], values[:90_000])
    before = history.window(int(times[40_000]), int(times[89_999]), 400, steps=False)
    history.add(times[90_000:90_002], values[90_000:90_002])
    after = history.window(int(times[40_002]), int(times[90_001]), 400, steps=False)
    assert before[1:-1] == after[1:-1]
    # The last value of each stretch lies in the window.
    assert [row[0] - START / 1e9 for row in (after[0], after[-1])] == [40_139, 90_001]
    assert after[-1][3] == values[90_001]


def test_a_week_is_kept_and_memory_is_bounded() -> None:
    """Ten weeks with a value every 10 s, in batches of any size."""
    history, chance = History(), random.Random(1)
    times = START + 10 * SECOND * np.arange(10 * 7 * 8640)
    first = 0
    while first < len(times):
        last = first + chance.choice([1, 100, 20_000])
        history.add(times[first:last], np.arange(first, min(last, len(times)), dtype=float))
        first = last
        assert len(history._times) <= 3 * MOST_STRETCHES
    end = int(times[-1])
    rows = history.window(end - 7 * 86_400 * SECOND, end, 400, steps=False)
    assert rows[0][0] < (end - 7 * 86_400 * SECOND) / 1e9 + 2000
    assert rows[-1][3] == len(times) - 1


def test_a_batch_longer_than_a_week_keeps_its_end() -> None:
    """Times without values take no space: here two stretches are an hour apart."""
    history = History()
    times = START + 180 * STRETCH_NS * np.arange(3 * MOST_STRETCHES)
    history.add(times, np.arange(3.0 * MOST_STRETCHES))
    most = MOST_STRETCHES
    rows = history.window(int(times[-most]), int(times[-1]), 180 * most, steps=True)
    assert [row[3] for row in rows] == [float(hour) for hour in range(2 * most, 3 * most)]


def test_times_at_which_a_value_was_unknown() -> None:
    """From when it was last known until it is known again; the newest may still last."""
    rows = [[float(at), 1.0, 1.0, 1.0] for at in range(0, 100, 10)]
    unknown = Gaps()
    assert unknown.cut_out(rows) == rows
    unknown.update(1e9, known=False)  # by another clock, before the run's own was known
    unknown.update(5.0, known=True)
    assert unknown.cut_out(rows) == rows
    unknown.update(25.0, known=True)
    unknown.update(27.0, known=False)
    unknown.update(45.0, known=False)
    unknown.update(55.0, known=True)
    nothing = [None, None, None]
    assert unknown.cut_out(rows) == [*rows[:3], [25.0, *nothing], *rows[6:]]
    unknown.update(75.0, known=False)
    assert unknown.is_unknown
    before = [*rows[:3], [25.0, *nothing], [55.0, *nothing]]
    assert unknown.cut_out(rows) == before
    unknown.update(76.0, known=True)
    assert unknown.cut_out(rows) == [*before, *rows[8:]]
    assert list(unknown.at(np.array([25.0, 26.0, 55.0, 75.0]))) == [False, True, False, True]
