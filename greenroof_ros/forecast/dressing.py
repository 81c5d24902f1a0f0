"""Dressed forecasts: an ensemble of the rain that was observed after similar forecasts.

A service's rain has the bias of its model, and no measure of its uncertainty. With an archive of
its forecasts and a record of rain, an issue can be replaced by the rain after its *analogs*: the
hours that were observed after each of the past issues most similar to it (Hamill and Whitaker 2006,
doi:10.1175/MWR3237.1; Delle Monache et al. 2013, doi:10.1175/MWR-D-12-00281.1). Members are spells
of the record, so their hours and days belong together without a Schaake shuffle (Clark et al. 2004,
Journal of Hydrometeorology 5:243).

**Expected rain.** Leads are divided into blocks that grow with the lead, as errors of timing do: to
6, 12, 24, 48, 72 and 120 h, and so on. The rain expected in a block, m, is a straight line of the
rain forecast for it, f (mm, the mean of the issue's members): m = a + b f. It is fitted to the past
issues by least squares, with a >= 0 and b >= 0, and goes through their means.

**Similarity.** The distance of two issues is the sum over blocks of (log m - log m')^2. It compares
the rain that they lead to, whatever the unit or the bias of the forecast, and weights a block by
the service's skill in it: without skill b is 0, all issues are alike, and the analogs are a random
draw from the record, its climatology. Ties are broken at random.

**Members.** The ten most similar issues that are two days or more apart, so that no storm counts
twice. Rain is skewed: most of the analogs of a wet issue are drier than it is. So the rain of each
analog's block is multiplied by m / m', limited to between a quarter and four. (Alessandrini et al.
2019, doi:10.1175/MWR-D-19-0006.1, correct analogs of rare events by a line of the forecasts too.)
Hours after the forecast's end are left as observed. Compared with unscaled analogs, this took the
bias of sums over 48 h from 0.87 to 1.03, and lowered their CRPS by 6 % (the three services
together).

**No leakage.** The line and the analogs of an issue use no issue whose time is within the length of
a member plus five days, before or after. So an issue of the archive that made the file is dressed
without the rain observed after it, and a season can be replayed with its own file.

The numbers of members, hours and days here were chosen at Budva, 2024-02-20 to 12-31, with GEM, GFS
and KNMI, by the CRPS of sums over 12, 48 and 120 h: of the whole period, and of its drier and
wetter half, each dressed by itself. Use other years to judge them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.times import from_epoch_ns, hours_since_1970, to_minutes
from greenroof_ros.forecast.choice import ForecastChoice
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import (
    HOUR,
    PRECIPITATION,
    QUANTITIES,
    Archive,
    Issue,
    Table,
    bridged,
    read_table,
)
from greenroof_ros.model.site import Site
from greenroof_ros.weather.series import Weather, on_the_hours

Array = NDArray[np.float64]

MEMBERS = 10
"""Of a dressed issue. With issues of five months 20 members score worse, because the last of them
are not similar to the issue; with issues of ten months they score 2 % better."""

# Ends of the blocks of leads (h); the last ends where the forecasts do.
_ENDS = (6, 12, 24, 48, 72, 120, 240)
# Least time between analogs of one issue (h).
_APART = 48
# Least time between issues that a live site adds (h).
_ISSUES_APART = 6
# Least time between the end of a member and the issue, or the other way round (h): longer than a
# spell of weather.
_BETWEEN = 120
# Longest gap of the record that is bridged by a straight line (h); no member has a longer one.
_BRIDGED = 12
# Least expected rain, as a share of the block's mean (1), and the largest factor of an analog's
# block: far from all past issues the line is not reliable.
_LEAST, _MOST_RATIO = 0.1, 4.0

# Limits (mm): what is plausible for an hour, and what many such hours add up to in a block.
_OF_AN_HOUR = ("mm", *QUANTITIES[PRECIPITATION][1:])
_OF_A_BLOCK = ("mm", 0.0, 1e6)

_FORECAST = re.compile(r"forecast of hours (\d{1,3}) to (\d{1,3}) \[mm\]")


@dataclass(frozen=True)
class Dressing:
    """Past issues and the rain observed after each; one row per issue.

    Attributes:
        source: the file, or the files that the dressing was made from.
        edges: of the blocks (h of lead), starting with 0, shape (blocks + 1,).
        issued: hours since 1970, shape (issues,).
        forecast: rain in each block (mm), shape (issues, blocks).
        fell: rain in each hour from the issue on (mm/h), shape (issues, hours). NaN if not
            measured, or not yet; an issue with NaN is no analog.
    """

    source: str
    edges: tuple[int, ...]
    issued: NDArray[np.int64]
    forecast: Array
    fell: Array

    @property
    def hours(self) -> int:
        """Length of a member (h)."""
        return int(self.fell.shape[1])

    def usable(self, issued: int) -> NDArray[np.intp]:
        """Return which issues are complete, and far enough from a time (hours since 1970)."""
        far = np.abs(self.issued - issued) >= self.hours + _BETWEEN
        return np.flatnonzero(far & ~np.isnan(self.fell).any(axis=1))

    def with_issue(self, issue: Issue) -> Dressing:
        """Return the dressing with one more issue, whose hours are still to come.

        It is left out if it is too short for the blocks, or less than six hours after the last.
        """
        issued = hours_since_1970(issue.issued)
        last = self.issued[-1] if self.issued.size else issued - _ISSUES_APART
        if issue.hours < self.edges[-1] or issued < last + _ISSUES_APART:
            return self
        forecast = block_sums(issue.rain[:, : self.edges[-1]].mean(axis=0), self.edges)
        return replace(
            self, issued=np.append(self.issued, issued),
            forecast=np.vstack([self.forecast, forecast]),
            fell=np.vstack([self.fell, np.full(self.hours, np.nan)]),
        )

    def with_hour(self, hour: int, rain: float) -> Dressing:
        """Return the dressing with the rain of an hour, added to all issues that cover the hour.

        Values that are already known are kept, even if the clock has since been set back.

        An issue is complete once its last hour has come. Gaps of up to 12 h are then bridged, as in
        :func:`learn`. An issue with a longer gap, or one at its beginning or end, is dropped.

        Args:
            hour: hours since 1970.
            rain: mm/h; NaN if not measured.
        """
        fell, lead = self.fell.copy(), hour - self.issued
        follows = np.flatnonzero((lead >= 0) & (lead < self.hours))
        known = fell[follows, lead[follows]]
        fell[follows, lead[follows]] = np.where(np.isnan(known), rain, known)
        ended = lead >= self.hours - 1
        for index in np.flatnonzero(ended & np.isnan(fell).any(axis=1)):
            fell[index] = bridged(fell[index], _BRIDGED)
        stays = ~(ended & np.isnan(fell).any(axis=1))
        return replace(
            self, issued=self.issued[stays], forecast=self.forecast[stays], fell=fell[stays]
        )

    @cached_property
    def _come(self) -> Array:
        """Rain observed in each block (mm), shape (issues, blocks)."""
        return block_sums(self.fell, self.edges)

    def members(self, issued: int, rain: Array) -> Array:
        """Return the rain after the issues most similar to one, the most similar first.

        Args:
            issued: the issue's time (hours since 1970).
            rain: mm/h, shape (members, hours). Blocks beyond its end are not compared, and are left
                as observed.

        Returns:
            mm/h, shape (MEMBERS, hours of this dressing).

        Raises:
            ConfigurationError: there are too few issues far enough from it.
        """
        # Breaks ties at random; the same draw for the same issue.
        usable = np.random.default_rng(abs(issued)).permutation(self.usable(issued))
        whole = [end for end in self.edges if end <= rain.shape[1]]
        blocks = len(whole) - 1
        now = block_sums(rain.mean(axis=0), whole)
        past = self.forecast[usable, :blocks]
        come = self._come[usable, :blocks]
        logs = np.log(_expected(past, come, np.vstack([now, past])))
        logs = logs[0] - logs[1:]
        distance = np.sum(logs**2, axis=1)
        chosen: list[int] = []
        while len(chosen) < MEMBERS:
            nearest = int(np.argmin(distance)) if distance.size else 0
            if not distance.size or np.isinf(distance[nearest]):
                time = from_epoch_ns(issued * 3600 * 10**9)
                raise ConfigurationError(
                    f"has only {len(chosen)} issues that are two days or more apart and at least "
                    f"{(self.hours + _BETWEEN) / 24:g} days from {to_minutes(time)} (an issue is "
                    f"not dressed by its own weather); {MEMBERS} are needed: add more months",
                    file=self.source,
                )
            chosen.append(nearest)
            distance[np.abs(self.issued[usable] - self.issued[usable[nearest]]) < _APART] = np.inf
        ratios = np.clip(np.exp(logs[chosen]), 1 / _MOST_RATIO, _MOST_RATIO)
        members: Array = self.fell[usable[chosen]]
        members[:, : whole[-1]] *= np.repeat(ratios, np.diff(whole), axis=1)
        return members


def block_sums(rain: Array, edges: Sequence[int]) -> Array:
    """Return the rain of each block (mm), shape (..., blocks).

    Args:
        rain: mm/h, shape (..., hours).
        edges: of the blocks (h), shape (blocks + 1,).
    """
    until = np.zeros((*rain.shape[:-1], rain.shape[-1] + 1))
    np.cumsum(rain, axis=-1, out=until[..., 1:])
    sums: Array = np.maximum(np.diff(until[..., list(edges)], axis=-1), 0.0)
    return sums


def _expected(forecast: Array, fell: Array, of: Array) -> Array:
    """Return the expected rain of each block (mm), shape (issues, blocks).

    Args:
        forecast: of past issues (mm), shape (past issues, blocks).
        fell: observed after them (mm), likewise.
        of: forecasts whose expected rain is returned (mm), shape (issues, blocks).
    """
    said, fallen = forecast.mean(axis=0), fell.mean(axis=0)
    variance = ((forecast - said) ** 2).mean(axis=0)
    covariance = ((forecast - said) * (fell - fallen)).mean(axis=0)
    slope = np.divide(covariance, variance, out=np.zeros_like(said), where=variance > 0)
    # The line goes through the means; up to this slope it is not negative at a forecast of 0.
    most = np.divide(fallen, said, out=np.zeros_like(said), where=said > 0)
    slope = np.clip(slope, 0.0, most)
    least = np.maximum(_LEAST * fallen, 1e-3)  # mm; so that a block without rain has a logarithm
    expected: Array = np.maximum(fallen + slope * (of - said), least)
    return expected


def learn(archive: Archive, weather: Weather, hours: int) -> Dressing:
    """Pair issues with the rain observed after them.

    Issues that are shorter than the longest (or a member), or for which the record lacks hours, are
    left out. Gaps of up to 12 h are first bridged by a straight line between the hours around them.

    Args:
        archive: of forecasts.
        weather: the record.
        hours: length of a member (h).

    Raises:
        ConfigurationError: an issue is not whole hours from the record, or no issue can be used.
    """
    archive = replace(archive, issues=on_the_hours(archive.issues, weather))
    longest = min(hours, max(issue.hours for issue in archive.issues))
    edges = (0, *(end for end in _ENDS if end < longest), longest)
    record = bridged(weather.precipitation, _BRIDGED)
    rows = []
    for issue in archive.issues:
        begin = (issue.issued - weather.rain_from) // HOUR
        if issue.hours < longest or begin < 0 or begin + hours > len(record):
            continue
        fell = record[begin : begin + hours]
        if not np.isnan(fell).any():
            rain = issue.rain[:, :longest].mean(axis=0)
            rows.append((hours_since_1970(issue.issued), block_sums(rain, edges), fell))
    if not rows:
        raise ConfigurationError(
            f"has no issue followed by {hours} h of {weather.source}; the record covers "
            f"{to_minutes(weather.first)} to {to_minutes(weather.end)}", file=archive.source,
        )
    issued, forecast, fell = map(np.array, zip(*rows, strict=True))
    return Dressing(f"{archive.source} and {weather.source}", edges, issued, forecast, fell)


def chosen_archive(choice: ForecastChoice, site: Site) -> Archive:
    """Return the archive of a choice, dressed if the choice says so.

    Raises:
        ConfigurationError: a file is invalid, or an issue has too few analogs.
    """
    assert choice.file is not None
    archive = read_archive(choice.file, site, choice.delay)
    return archive if choice.dressed is None else dress(archive, read_dressing(choice.dressed))


def dress(archive: Archive, dressing: Dressing) -> Archive:
    """Return an archive in which each issue is replaced by the ensemble of its analogs.

    Evapotranspiration is kept as forecast, and continued as it is after any forecast's end.

    Raises:
        ConfigurationError: an issue has too few analogs.
    """
    issues = [dress_issue(issue, dressing) for issue in archive.issues]
    return replace(
        archive, kind=f"{archive.kind}, dressed by {dressing.source}", issues=tuple(issues),
        verified=tuple(issues), finest_lead=1,
    )


def dress_issue(issue: Issue, dressing: Dressing) -> Issue:
    """Return the ensemble of an issue's analogs; temperature is NaN after the issue's end.

    Raises:
        ConfigurationError: it has too few analogs.
    """
    temperature = issue.temperature
    if temperature is not None:
        temperature = np.append(temperature, np.full(dressing.hours, np.nan))[: dressing.hours]
    return replace(
        issue,
        rain=dressing.members(hours_since_1970(issue.issued), issue.rain),
        evapotranspiration=issue.evapotranspiration_at(np.arange(dressing.hours)),
        temperature=temperature,
    )


def dressing_text(dressing: Dressing) -> str:
    """Return the text of a dressing's file, which :func:`read_dressing` reads."""
    lines = [
        "# Forecasts and the rain observed after them, for --dressed of simulate, run and verify:",
        f"# {dressing.source}.", ",".join(_columns(dressing.edges, dressing.hours)),
    ]
    values = np.concatenate([dressing.forecast, dressing.fell], axis=1).tolist()
    for issued, row in zip(dressing.issued.tolist(), values, strict=True):
        time = from_epoch_ns(issued * 3600 * 10**9).isoformat()
        lines.append(",".join([time, *("" if math.isnan(x) else f"{x:.6g}" for x in row)]))
    return "\n".join([*lines, ""])


def read_dressing(path: Path) -> Dressing:
    """Read a file that :func:`dressing_text` has written.

    Lines that start with ``#`` are comments. The first other line is the header: ``issued``, the
    forecast's blocks, each beginning where the previous one ends, and the hours from 0 on. Each
    further line is an issue: its time (ISO 8601 with the offset from UTC), later than the line
    above; the rain forecast for each block (mm); and the rain observed in each hour from then on
    (mm), empty if not measured, or not yet.

    Raises:
        ConfigurationError: the file breaks any of this; the message names the line and value.
    """
    table = read_table(path)
    edges, hours = _read_header(table)
    issued = [hours_since_1970(time) for time in table.times("issued")]
    for row, (above, time) in enumerate(pairwise(issued), start=1):
        if time <= above:
            raise table.refuse("must be later than the issue above it", "issued", row)
    forecast = [table.numbers(column, _OF_A_BLOCK) for column in table.header[1 : len(edges)]]
    fell = [table.numbers(column, _OF_AN_HOUR, missing=("",)) for column in table.header[-hours:]]
    return Dressing(
        str(path), edges, np.array(issued), np.column_stack(forecast), np.column_stack(fell)
    )


def _read_header(table: Table) -> tuple[tuple[int, ...], int]:
    """Return the blocks' edges and the number of hours from a header.

    Raises:
        ConfigurationError: it is not the header of a dressing.
    """
    edges = [0]
    for cell in table.header[1:]:
        match = _FORECAST.fullmatch(cell)
        if match is None:
            break
        edges.append(int(match[2]))
    hours = len(table.header) - len(edges)
    table.require_header(
        _columns(edges, hours), ": a file for --dressed is made by 'greenroof verify --dress "
        "ARCHIVE --weather RECORD -o FILE'",
    )
    if len(edges) < 2 or sorted(set(edges)) != edges or hours < edges[-1]:
        raise table.refuse(
            "must have consecutive forecast blocks, and all their hours"
        )
    return tuple(edges), hours


def _columns(edges: Sequence[int], hours: int) -> list[str]:
    """Return the header of a file."""
    blocks = [f"forecast of hours {begin} to {end} [mm]" for begin, end in pairwise(edges)]
    return ["issued", *blocks, *(f"fell in hour {hour} [mm]" for hour in range(hours))]
