"""Analogs as defined, climatology without skill, and files."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from paper import weather_of
from refusals import refusal

from greenroof_ros.common.times import hours_since_1970
from greenroof_ros.forecast.dressing import (
    MEMBERS,
    Dressing,
    dress,
    dress_issue,
    dressing_text,
    learn,
    read_dressing,
)
from greenroof_ros.formats.records import Archive, Issue
from greenroof_ros.weather.series import Weather

HOUR = timedelta(hours=1)
FIRST = datetime(2024, 1, 1, tzinfo=timezone.utc)
Array = np.ndarray


def record(rain: Array) -> Weather:
    """Return hourly records of rain from the first hour on."""
    return weather_of(rain, 0.0, FIRST)


def archive(issues: dict[int, Array]) -> Archive:
    """Return an archive by the hour of each issue and its rain, shape (members, hours)."""
    made = tuple(
        Issue(FIRST + hour * HOUR, Path("archive.csv"), 2, rain) for hour, rain in issues.items()
    )
    return Archive(Path("archive.csv"), "own form", made, 0.0, made, 1)


def showers(hours: int, seed: int) -> Array:
    """Return rain that comes in spells of some hours (mm/h)."""
    rng = np.random.default_rng(seed)
    wet = np.repeat(rng.random(hours // 6 + 1) < 0.12, 6)[:hours]
    rain: Array = np.round(wet * rng.gamma(0.6, 3.0, hours), 1)
    return rain


def forecasts(
    rain: Array, every: int, hours: int, seed: int, skill: float = 1.0
) -> dict[int, Array]:
    """Return issues that know a share of the rain to come, and have too much water."""
    rng = np.random.default_rng(seed)
    others = rng.permutation(len(rain) - hours)
    return {
        start: 1.7 * (
            skill * rain[start : start + hours]
            + (1 - skill) * rain[others[start] : others[start] + hours]
        )[None, :] * rng.gamma(4.0, 0.25)
        for start in range(0, len(rain) - hours, every)
    }


def learnt() -> Dressing:
    """Return the issues of eighty days, of 24 h, and 30 h after each."""
    rain = showers(80 * 24, 13)
    return learn(archive(forecasts(rain, 24, 24, 14)), record(rain), 30)


def by_definition(issues: dict[int, Array], rain: Array, start: int, hours: int) -> list[Array]:
    """Return the members of an issue by the definition, step by step."""
    edges = [*(edge for edge in (0, 6, 12, 24, 48, 72, 120) if edge < hours), hours]
    blocks = list(itertools.pairwise(edges))
    # Nothing that was forecast or fell within five days of the issue's own hours.
    past = [at for at in issues if abs(at - start) >= hours + 120 and at + hours <= len(rain)]
    said = {at: [issues[at][:, a:b].sum(axis=1).mean() for a, b in blocks] for at in issues}
    fell = {at: [rain[at + a : at + b].sum() for a, b in blocks] for at in past}
    expected: dict[int, list[float]] = {at: [] for at in issues}
    for block in range(len(blocks)):
        x, y = (np.array([sums[at][block] for at in past]) for sums in (said, fell))
        slope = np.clip(np.cov(x, y)[0, 1] / np.var(x, ddof=1), 0.0, y.mean() / x.mean())
        for at in issues:
            line = y.mean() + slope * (said[at][block] - x.mean())
            expected[at].append(max(line, 0.1 * y.mean()))
    ratios = {at: np.divide(expected[start], expected[at]) for at in past}
    chosen: list[int] = []
    for at in sorted(past, key=lambda at: (np.log(ratios[at]) ** 2).sum()):
        if len(chosen) < 10 and all(abs(at - other) >= 48 for other in chosen):
            chosen.append(at)
    factors = [np.repeat(np.clip(ratios[at], 0.25, 4.0), np.diff(edges)) for at in chosen]
    return [rain[at : at + hours] * factor for at, factor in zip(chosen, factors, strict=True)]


def test_analogs_are_as_by_definition() -> None:
    """Lines, distances, choice and corrected members of an ensemble's issues."""
    rain = showers(120 * 24, 1)
    single, second = (forecasts(rain, 12, 60, seed, skill=0.6) for seed in (2, 3))
    # No two are alike; equal ones would be drawn by lot.
    rng = np.random.default_rng(4)
    issues = {
        start: np.vstack([rain, second[start]]) + rng.uniform(0, 0.01, (2, 60))
        for start, rain in single.items()
    }
    dressing = learn(archive(issues), record(rain), 60)
    assert dressing.edges == (0, 6, 12, 24, 48, 60)
    for start in (0, 1200, 2784):
        members = dressing.members(hours_since_1970(FIRST) + start, issues[start])
        expected = by_definition(issues, rain, start, 60)
        np.testing.assert_allclose(members, expected, rtol=1e-9, atol=1e-9)


def test_no_skill_is_climatology() -> None:
    """After constant forecasts members are spells of the record as they fell, drawn by lot."""
    rain = np.random.default_rng(9).uniform(0, 9, 80 * 24)
    given = archive({at: np.full((1, 24), 0.2) for at in range(0, 78 * 24, 24)})
    dressing = learn(given, record(rain), 24)
    drawn = [dressing.members(int(at), np.full((1, 24), 0.2)) for at in dressing.issued[-20:]]
    assert len({members.tobytes() for members in drawn}) == 20
    spells = dressing.fell.tolist()
    assert all(member in spells for members in drawn for member in members.tolist())


def test_gaps_and_ends() -> None:
    """Gaps of 12 h are bridged, of 13 h are in no member; short issues are not learned."""
    rain = np.ones(90 * 24)
    rain[600:612] = np.nan
    rain[612] = 2.0
    rain[1200:1213] = np.nan
    issues = {at: np.ones((1, 24)) for at in range(0, 90 * 24, 24)}
    issues[48] = np.ones((1, 23))
    dressing = learn(archive(issues), record(rain), 36)
    starts = (dressing.issued - hours_since_1970(FIRST)).tolist()
    assert 48 not in starts
    assert [at for at in issues if at not in starts] == [48, 1176, 1200, 2136]
    row = dressing.fell[starts.index(600)]
    np.testing.assert_allclose(row[:12], 1 + np.arange(1, 13) / 13)
    # Beyond the forecast's end rain is as it fell, and a short issue gets as many hours.
    assert dressing.edges == (0, 6, 12, 24)
    short = Issue(FIRST + 48 * HOUR, Path("live.csv"), None, np.ones((1, 5)), np.arange(5.0))
    dressed = dress_issue(short, dressing)
    assert dressed.rain.shape == (MEMBERS, 36)
    assert dressed.evapotranspiration is not None
    day = [*range(5), *[4] * 19]  # an hour that the issue lacks is like its last
    assert dressed.evapotranspiration.tolist() == [*day, *day][:36]


def test_rain_that_stands_an_hour_late() -> None:
    """Rain is used when it fell; the record's first hour is that before its first time."""
    rain = np.arange(60.0 * 24)
    late = replace(record(rain), rain_late=1)
    dressing = learn(archive({at: np.ones((1, 24)) for at in (0, 24, 48)}), late, 24)
    assert dressing.fell[:, 0].tolist() == [1.0, 25.0, 49.0]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("issued,", "time,", "line 3: 'time': the column must be 'issued': a file for --dr"),
        ("hours 6 to 12", "hours 7 to 12", "line 3: 'forecast of hours 7 to 12 [mm]': the "),
        ("2024-01-02", "2023-12-02", "line 5: issued = '2023-12-02T00:00:00+00:00': must be"),
        ("01T00:00:00+00:00,", "01T00:00:00+00:00,-1", "line 4: forecast of hours 0 to 6 [mm] = "),
    ],
)
def test_wrong_files(tmp_path: Path, old: str, new: str, words: str) -> None:
    """The error has file, line, value and what would be right."""
    text, path = dressing_text(learnt()), tmp_path / "dressed.csv"
    assert old in text
    path.write_text(text.replace(old, new, 1))
    assert refusal(read_dressing, path).startswith(f"{path}, {words}")


def test_hour_by_hour_as_all_at_once(tmp_path: Path) -> None:
    """A live site that adds issues and hours ends with what a complete record would teach it.

    On the way a gap of twelve hours is bridged, except for issues that begin or end in it; one of
    thirteen hours drops issues. Unfinished issues are in no member, and survive in the file.
    """
    rain = showers(120 * 24, 21)
    rain[2000:2012] = np.nan
    rain[2400:2413] = np.nan
    issues = forecasts(np.nan_to_num(rain), 12, 24, 22)
    whole = learn(archive(issues), record(rain), 30)
    growing = learn(archive(issues), record(rain[: 60 * 24]), 30)
    known = len(growing.issued)
    for hour in range((known - 1) * 12 + 1, len(rain)):
        if hour in issues:
            growing = growing.with_issue(
                Issue(FIRST + hour * HOUR, Path("live.csv"), 2, issues[hour])
            )
        since = hours_since_1970(FIRST) + hour
        growing = growing.with_hour(since, rain[hour])
        if hour == 2500:
            file = tmp_path / "dressed.csv"
            file.write_text(dressing_text(growing))
            again = read_dressing(file)
            assert (again.edges, again.source) == (growing.edges, str(file))
            assert again.issued.tolist() == growing.issued.tolist()
            np.testing.assert_allclose(again.forecast, growing.forecast, rtol=1e-5)
            np.testing.assert_allclose(again.fell, growing.fell, rtol=1e-5)
            unfinished = np.isnan(growing.fell).any(axis=1).sum()
            assert 0 < unfinished <= 3
            assert not np.isnan(again.members(since, issues[2496])).any()
    unfinished = np.isnan(growing.fell).any(axis=1)
    assert unfinished.sum() < 3
    assert len(whole.issued) > known + 100
    starts = whole.issued - hours_since_1970(FIRST)
    cut = [at for at in starts if 2000 <= at < 2012 or 2000 <= at + 29 < 2012]
    assert len(cut) == 2
    kept = ~np.isin(starts, cut)
    assert growing.issued[~unfinished].tolist() == whole.issued[kept].tolist()
    np.testing.assert_allclose(growing.fell[~unfinished], whole.fell[kept])
    np.testing.assert_allclose(growing.forecast[~unfinished], whole.forecast[kept])


def test_a_clock_that_goes_back() -> None:
    """Known hours stay known; with no issues left, the number of hours is kept."""
    dressing = again = learnt()
    for hour in range(24 * 10, 24 * 15):
        again = again.with_hour(hours_since_1970(FIRST) + hour, math.nan if hour % 3 else 7.0)
    assert again.issued.tolist() == dressing.issued.tolist()
    assert np.array_equal(again.fell, dressing.fell)
    late = replace(dressing, fell=np.full_like(dressing.fell, np.nan))
    none = late.with_hour(hours_since_1970(FIRST) + 10_000, 1.0)
    assert (len(none.issued), none.hours) == (0, 30)
    assert none.with_hour(hours_since_1970(FIRST) + 10_001, 1.0).hours == 30


def test_issues_that_teach_nothing() -> None:
    """An issue too short for the blocks, or less than six hours after the last."""
    dressing = learnt()
    last = FIRST + (dressing.issued[-1] - hours_since_1970(FIRST)) * HOUR

    def added(after: int, hours: int) -> int:
        issue = Issue(last + after * HOUR, Path("live.csv"), 2, np.ones((1, hours)))
        return len(dressing.with_issue(issue).issued) - len(dressing.issued)

    assert [added(5, 24), added(6, 23), added(6, 24)] == [0, 0, 1]


def test_too_few_issues() -> None:
    """The error says how many there are, and in which file; records of another time have none."""
    rain = showers(25 * 24, 15)
    given = archive(forecasts(rain, 24, 24, 16))
    refusal(dress, given, learn(given, record(rain), 24), match="has only 8 issues that are two")
    late = replace(given, issues=tuple(
        replace(issue, issued=issue.issued + 1000 * HOUR) for issue in given.issues
    ))
    refusal(learn, late, record(rain), 24, match=r"has no issue followed by 24 h of drawn.csv")
