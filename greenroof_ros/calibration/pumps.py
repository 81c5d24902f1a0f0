"""The pumps of a site, from how fast their cistern falls while they run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from greenroof_ros.calibration.checks import FINDINGS
from greenroof_ros.calibration.fit import Parameter, freedom, half_intervals, moves
from greenroof_ros.calibration.record import Record, Steps, Values, lately
from greenroof_ros.common.quality import Finding
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

# So long after rain a catchment still runs (s), and so far from the levels of outlet, valve and
# suction a sensor's noise does not matter (m).
_WET_S = 3600
_APART_M = 0.05
_STANDING_STEPS, _STANDING_S = 2, 600
_FEWEST_LEVELS = 3
_FEWEST_RUNS = 10
# Tukey's biweight, in typical residuals: 95 % efficient where nothing is wrong (Holland and Welsch
# 1977, doi:10.1080/03610927708827533). It begins at Huber's weights, which have one solution.
_BIWEIGHT = 4.685
_HUBER_ROUNDS, _MOST_ROUNDS, _SETTLED = 5, 50, 1e-3
# Of shares: the step by which a derivative is taken, and the least.
_SHARE, _LEAST_SHARE = 1e-4, 1e-3
# No level is told better (m).
_LEAST_M = 1e-4
# A rise of so many typical residuals is no noise: two levels of white noise are as far apart once
# in a million times.
_RISE = 7.0
# Of steps: a delay that is named, and runs too short to be told from shorter ones.
_NAMED, _SHORT = 0.5, 2
# So many times its curve's flow no pump lifts, nor so small a part.
_BELIEVABLE = 10.0
# A half of its interval this large, as a share of the parameter, says little.
_HARDLY = 0.5


class Runs(NamedTuple):
    """The levels of each run, from before its beginning to after its end, one run after another."""

    step: NDArray[np.int64]
    """that each level is at the beginning of, shape (n,)"""
    level: Values
    """m, shape (n,)"""
    number: NDArray[np.int64]
    """of the run that each level is of, from 0"""
    counts: Steps
    """whether a level counts in the fit, shape (n,)"""

    @property
    def sizes(self) -> NDArray[np.int64]:
        """How many levels of each run count."""
        return np.bincount(self.number, self.counts).astype(np.int64)

    @property
    def between(self) -> Values:
        """Mean of each level and the next (m); at the end of a run that level itself."""
        last = np.append(self.number[1:] != self.number[:-1], True)
        return np.where(last, self.level, (self.level + np.append(self.level[1:], 0.0)) / 2)

    def only(self, kept: Steps) -> Runs:
        """Return the runs that are kept, numbered from 0 on; ``kept`` has an entry for each run."""
        here = kept[self.number]
        number = (np.cumsum(kept) - 1)[self.number[here]]
        return Runs(self.step[here], self.level[here], number, self.counts[here])

    def without(self, levels: Steps) -> Runs:
        """Return runs in which these levels do not count, those of three others at least."""
        fewer = self._replace(counts=self.counts & ~levels)
        return fewer.only(fewer.sizes >= _FEWEST_LEVELS)

    def less_means(self, values: Values) -> Values:
        """Return values of levels, less their mean over each run; 0 where they do not count."""
        means = np.bincount(self.number, values * self.counts) / self.sizes
        return np.where(self.counts, values - means[self.number], 0.0)

    def typical(self, residuals: Values) -> Values:
        """Return the standard deviation in each run of what :meth:`less_means` has left."""
        return np.sqrt(np.bincount(self.number, residuals**2) / (self.sizes - 1))

    def lasting(self, command: Values) -> Values:
        """Return of each run in how many steps the pumps ran."""
        return np.asarray(np.bincount(self.number, command[self.step] > 0))

    def rises(self) -> Values:
        """Return by how much in each run a level is above an earlier one, at most (m)."""
        ends = np.cumsum(np.bincount(self.number))[:-1]
        each = np.split(self.level, ends)
        return np.array([np.max(one - np.minimum.accumulate(one)) for one in each])


def standing_steps(step_s: float) -> int:
    """Return from how many steps before a run to how many after it levels count.

    By so much the pump state may be late or early: that of a logger by a step or two, that of a
    drive by minutes.
    """
    return max(_STANDING_STEPS, round(_STANDING_S / step_s))


def find_runs(site: Site, record: Record, command: Values, cistern: Values) -> Runs:
    """Return the runs in which nothing but the pumps moves the cistern.

    A run counts as far as it did not rain for an hour, the level is between the outlet and the
    lowest at which pumps and mains leave it, and all is known. Where two runs are near each other,
    each has half of the levels between them.
    """
    standing = standing_steps(record.step_s)
    quiet = _quiet(site, record, command, cistern, standing)
    found = gaps(quiet & (command > 0))
    still = quiet & (command == 0)
    levels = []
    for place, (first, end) in enumerate(found):
        low, high = max(0, first - standing), min(end + standing, record.steps - 1)
        if place > 0:
            low = max(low, (found[place - 1][1] + first + 1) // 2)
        if place + 1 < len(found):
            high = min(high, (end + found[place + 1][0] - 1) // 2)
        busy_before = np.flatnonzero(~still[low:first])
        busy_after = np.flatnonzero(~still[end:high])
        low += busy_before[-1] + 1 if len(busy_before) else 0
        high = end + busy_after[0] if len(busy_after) else high
        levels.append(np.arange(low, high + 1))
    if not levels:
        empty = np.zeros(0, dtype=np.int64)
        return Runs(empty, np.zeros(0), empty, empty > 0)
    step = np.concatenate(levels)
    number = np.repeat(np.arange(len(levels)), [len(one) for one in levels])
    return Runs(step, cistern[step], number, step >= 0)


def _quiet(
    site: Site, record: Record, command: Values, level: Values, standing: int
) -> Steps:
    """Return in which steps nothing but the pumps moves the cistern."""
    recent = lately(~(record.rain == 0), round(_WET_S / record.step_s) + 1)
    reach = standing + 2
    unknown = np.convolve(np.isnan(command), np.ones(2 * reach + 1), "same") > 0
    low = max(site.suction_level, site.mains_level or 0.0) + _APART_M
    between = (level > low) & (level < site.lowest_outlet - _APART_M)
    return np.asarray(between & np.append(between[1:], False) & ~recent & ~unknown)


class _Solution(NamedTuple):
    """A fit: shares, or the values that follow from them."""

    shares: Values
    others: Values
    """what each run would make of them by its absence, shape (runs, shares)"""
    freedom: Values
    """degrees of each share's interval"""
    size: Values
    """typical residual of each run (m), of those that do not count, too"""
    most: float
    """of which the flow is a share (m3/s)"""

    @property
    def half(self) -> Values:
        """Half of each share's interval."""
        return half_intervals(self.others, self.freedom)


class _Fall:
    """What runs leave in the cistern, by the shares that are fitted.

    These are the delay of the pump state in steps, the flow as a share of the site's, and, if
    there is a third, 1 / H as a share of the site's. Without it ``a_hat`` makes it.
    """

    def __init__(self, site: Site, record: Record, command: Values, runs: Runs) -> None:
        self._site = site
        self._runs = runs
        self._between = runs.between
        self._step_s = record.step_s
        self._total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(command))))
        self.middle = float(np.average(self._between, weights=command[runs.step]))
        self.most = maximum_pump_flow(site, self.middle * site.a1)
        self._head = self.middle + site.c_hat - site.d

    def residuals(self, shares: Values) -> Values:
        """Return the levels of each run with what the pumps took put back, less their mean (m)."""
        slope = (shares[2] if len(shares) > 2 else shares[1] ** -2) / self._head
        head = np.sqrt(np.maximum(1 + slope * (self._between - self.middle), 0.0))
        steps = np.arange(len(self._total))
        begin, end = (
            np.interp(self._runs.step + later + shares[0], steps, self._total) for later in (0, 1)
        )
        taken = self.most * shares[1] * head * (end - begin) * self._step_s / self._site.a1
        return self._runs.less_means(self._runs.level + np.cumsum(taken) - taken)

    def jacobian(self, shares: Values) -> Values:
        """Return how residuals change with the shares, shape (n, shares).

        With the delay they change by other slopes to both sides of a whole step; this is the mean.
        """
        return np.column_stack([
            (self.residuals(shares + step) - self.residuals(shares - step)) / (2 * _SHARE)
            for step in _SHARE * np.eye(len(shares))
        ])

    def derived(self, shares: Values) -> Values:
        """Return flow, a_hat and c_hat, shape (..., 3)."""
        site = self._site
        flow = self.most * shares[..., 1]
        lifted = self._head * (
            shares[..., 1] ** 2 if shares.shape[-1] == 2 else 1 / shares[..., 2]
        )
        return np.stack(
            [flow, site.pipe_resistance - lifted / flow**2, lifted + site.d - self.middle], axis=-1
        )

    def solve(self, shares: int, latest: int) -> _Solution:
        """Fit two or three shares, with less weight to runs that fit less well.

        Args:
            shares: how many.
            latest: by how many steps the pump state may be late or early.
        """
        low = np.array([-latest, *[_LEAST_SHARE] * 2])[:shares]
        high = np.array([latest, *[1 / _LEAST_SHARE] * 2])[:shares]
        at = np.array([0.0, 1.0, 1.0])[:shares]
        weights = np.ones(len(self._runs.sizes))
        for rounds in range(_MOST_ROUNDS):
            root = np.sqrt(weights)[self._runs.number]
            found: OptimizeResult = least_squares(
                lambda near, root=root: root * self.residuals(near), at,
                jac=lambda near, root=root: root[:, None] * self.jacobian(near),
                bounds=(low, high),
            )
            at = found.x
            size = self._runs.typical(self.residuals(at))
            relative = size / max(float(np.median(size)), _LEAST_M)
            before, weights = weights, np.maximum(1 - (relative / _BIWEIGHT) ** 2, 0.0) ** 2
            if rounds < _HUBER_ROUNDS:
                weights = 1 / np.maximum(relative, 1.0)
            elif np.max(np.abs(weights - before)) < _SETTLED:
                break
        counts = root > 0
        jacobian, groups = found.jac[counts], self._runs.number[counts]
        return _Solution(
            at, at + moves(jacobian, found.fun[counts], groups), freedom(jacobian, groups), size,
            self.most,
        )


class PumpFit(NamedTuple):
    """The pumps as the cistern shows them."""

    site: Site
    """with their curve; as it was where the record does not tell it"""
    parameters: Sequence[Parameter]
    """``a_hat`` and ``c_hat``; empty likewise"""
    findings: Sequence[Finding]
    """what they lift, what the record leaves open, or why it cannot be true"""


def fit_pumps(site: Site, record: Record) -> PumpFit:
    """Fit the pump curve to the fall of the cistern while the pumps run and nothing flows in.

    At command 1 and a level z they lift, by Eqs. (3b)-(3e),

        q(z) = Q sqrt(1 + (z - Z) / H),  H = Z + c_hat - d,  Q^2 = H / (pipe_resistance - a_hat),

    with Z the mean level: Q is how much they lift, and H what a level changes in it. At a command
    they lift that share. The levels of each run and of some time before and after it, but for their
    mean, are brought near to what that leaves in the cistern, by least squares; so a sensor's
    offset does not count, and its noise is that of all levels of a run. How much the pump state is
    late or early is fitted, too: the levels before and after show when the cistern falls.

    Runs in which the cistern rises by more than its noise are left out, and others count less the
    less they fit (Tukey's biweight, of a run's residuals over those of the median run). Intervals
    are those of :func:`.fit.half_intervals`, with runs as groups, and as many
    degrees of freedom as the runs have together.

    A cistern that falls by nothing like what the pumps can lift, or at another time than they run,
    is a refusal among the findings, and tells nothing of the curve. Nor do fewer than ten runs that
    count, by :func:`find_runs`.

    Where levels change the head by too little to tell H, ``a_hat`` stays as it is, and ``c_hat``
    follows from Q alone.

    Args:
        site: its cistern and pipe, and the curve that is held where the data do not tell it.
        record: what was measured; without a command or a level of the cistern nothing is found.
    """
    command, cistern = record.command, record.cistern
    if command is None or cistern is None:
        return PumpFit(site, (), ())
    unseen = PumpFit(site, (), [FINDINGS.make("pumps", "unseen", "pumps")])
    runs = find_runs(site, record, command, cistern)
    if len(runs.sizes) < _FEWEST_RUNS:
        return unseen
    standing = standing_steps(record.step_s)
    coarse = _Fall(site, record, command, runs).solve(3, standing + 1)
    doubts = _doubts(record, coarse, standing)
    if doubts:
        return PumpFit(site, (), doubts)
    late = round(coarse.shares[0])
    # The command as it was so many steps earlier.
    command = np.pad(command, abs(late), constant_values=np.nan)[abs(late) + late:][:len(command)]
    runs = find_runs(site, record, command, cistern)
    # The levels at which pumps start or stop do not count: the least part of a step by which the
    # pump state is late moves one of both, whichever the noise prefers, and the flow is too large.
    runs = runs.without(np.append(False, np.diff(command > 0))[runs.step])
    every = len(runs.sizes)
    runs = runs.only(runs.rises() <= _RISE * max(float(np.median(coarse.size)), _LEAST_M))
    if len(runs.sizes) < _FEWEST_RUNS:
        return unseen
    fall = _Fall(site, record, command, runs)
    found = fall.solve(3, 1)
    told = fall.derived(found.shares)[1] < 0 and found.half[2] < _HARDLY * min(found.shares[2], 1.0)
    if not told:
        found = fall.solve(2, 1)
    flow, a_hat, c_hat = fall.derived(found.shares).tolist()
    half = half_intervals(fall.derived(found.others), found.freedom[[1, -1, -1]]).tolist()
    shape = Parameter("a_hat", a_hat, a_hat - half[1], a_hat + half[1], "")
    if not told:
        shape = Parameter(
            "a_hat", site.a_hat, np.nan, np.nan, "the data cannot tell it apart from c_hat"
        )
    height = Parameter("c_hat", c_hat, c_hat - half[2], c_hat + half[2], "")
    count = len(found.others)
    delay = late + float(found.shares[0])
    findings = [FINDINGS.make(
        "pumps", "flow", "pumps", flow=1000 * flow, half=1000 * half[0], level=fall.middle,
        runs=count, late_s=delay * record.step_s, late_half_s=float(found.half[0] * record.step_s),
    )]
    if every > count:
        findings.append(FINDINGS.make("pumps", "left out", "pumps", runs=every - count))
    findings += _logger(record, command, runs, delay)
    return PumpFit(replace(site, a_hat=shape.value, c_hat=c_hat), [shape, height], findings)


def _logger(record: Record, command: Values, runs: Runs, late: float) -> list[Finding]:
    """Return what the logger does: it is late or early, or too coarse for the runs.

    A logger that writes what it sees once a step makes runs longer or shorter by up to a step; and
    of those shorter than a step it sees the longer ones more often.
    """
    findings = []
    if abs(late) >= _NAMED:
        findings.append(FINDINGS.make(
            "pumps", "shifted", "pumps", minutes=abs(late) * record.step_s / 60,
            side="late" if late > 0 else "early",
        ))
    steps = float(np.quantile(runs.lasting(command), 0.9))
    if steps <= _SHORT:
        findings.append(FINDINGS.make("pumps", "short", "pumps", steps=steps))
    return findings


def _doubts(record: Record, found: _Solution, standing: int) -> list[Finding]:
    """Return why a fall is not that of these pumps, or not at the time that they run."""
    late, share = found.shares[:2].tolist()
    if not 1 / _BELIEVABLE < share < _BELIEVABLE:
        return [FINDINGS.make(
            "unit-error", "pump", "cistern level", flow=1000 * found.most * share,
            curve=1000 * found.most,
        )]
    if abs(late) > standing + 0.5 and found.half[1] < _HARDLY * share:
        return [FINDINGS.make(
            "clock-shifted", "pump", "pump state", minutes=standing * record.step_s / 60,
            side="after" if late > 0 else "before",
        )]
    return []
