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
from greenroof_ros.calibration.record import Record, Steps, Values, greatest_rise, lately
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
# Of shares: the step of a derivative, and the least.
_SHARE, _LEAST_SHARE = 1e-4, 1e-3
# No level is known better (m).
_LEAST_M = 1e-4
# A rise of so many typical residuals is no noise: two levels of white noise are as far apart once
# in a million times.
_RISE = 7.0
# Of steps: a delay that is named, and runs too short to be told apart from shorter ones.
_NAMED, _SHORT = 0.5, 2
# So many times its curve's flow no pump lifts, nor so small a part.
_BELIEVABLE = 10.0
# A half of its interval this large, as a share of the parameter, says little.
_HARDLY = 0.5


def standing_steps(step_s: float) -> int:
    """Return from how many steps before a run to how many after it levels count.

    By so much the pump state may be late or early: a logger's by a step or two, a drive's
    by minutes.
    """
    return max(_STANDING_STEPS, round(_STANDING_S / step_s))


def find_runs(
    site: Site, record: Record, command: Values, cistern: Values
) -> list[NDArray[np.int64]]:
    """Return the runs in which nothing but the pumps moves the cistern.

    Each is the steps at whose beginnings its levels are, from before its beginning to after its
    end. A run counts as far as it did not rain for an hour, the level is between the outlet and the
    lowest at which pumps and mains leave it, and all is known. Where two runs are near each other,
    each has half of the levels between them.
    """
    standing = standing_steps(record.step_s)
    quiet = _quiet(site, record, command, cistern, standing)
    spans = gaps(quiet & (command > 0))
    moving = ~(quiet & (command == 0))
    runs = []
    for place, (first, end) in enumerate(spans):
        low, high = max(0, first - standing), min(end + standing, record.steps - 1)
        if place > 0:
            low = max(low, (spans[place - 1][1] + first + 1) // 2)
        if place + 1 < len(spans):
            high = min(high, (end + spans[place + 1][0] - 1) // 2)
        before, after = np.flatnonzero(moving[low:first]), np.flatnonzero(moving[end:high])
        low += before[-1] + 1 if len(before) else 0
        high = end + after[0] if len(after) else high
        runs.append(np.arange(low, high + 1))
    return runs


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
    """A fit of shares."""

    shares: Values
    others: Values
    """what each run would make of them by its absence, shape (runs, shares)"""
    freedom: Values
    """degrees of each share's interval"""
    size: float
    """residual of the median run (m), of those that do not count, too"""

    @property
    def half(self) -> Values:
        """Half of each share's interval."""
        return half_intervals(self.others, self.freedom)


class _Fall:
    """What runs leave in the cistern, by the shares that are fitted.

    These are the delay of the pump state in steps, the flow as a share of the site's, and, if
    there is a third, 1 / H as a share of the site's. Without it ``a_hat`` makes it.
    """

    def __init__(
        self, site: Site, step_s: float, command: Values, cistern: Values,
        runs: Sequence[NDArray[np.int64]], counts: Steps,
    ) -> None:
        """Take the levels of all runs (m), and of each step whether its level counts."""
        self._site, self._step_s = site, step_s
        self._step = np.concatenate(runs)
        self._number = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        self._counts = counts[self._step]
        self._sizes = np.bincount(self._number, self._counts)
        self._level = level = cistern[self._step]
        # Mean of each level and the next; at the end of a run that level itself.
        last = np.append(self._number[1:] != self._number[:-1], True)
        self._between = np.where(last, level, (level + np.append(level[1:], 0.0)) / 2)
        self._total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(command))))
        self.middle = float(np.average(self._between, weights=command[self._step]))
        self.most = maximum_pump_flow(site, self.middle * site.a1)
        self._head = self.middle + site.c_hat - site.d

    def residuals(self, shares: Values) -> Values:
        """Return the levels of each run with what the pumps took put back, less their mean (m)."""
        slope = (shares[2] if len(shares) > 2 else shares[1] ** -2) / self._head
        head = np.sqrt(np.maximum(1 + slope * (self._between - self.middle), 0.0))
        steps = np.arange(len(self._total))
        begin, end = (
            np.interp(self._step + later + shares[0], steps, self._total) for later in (0, 1)
        )
        pumped = self.most * shares[1] * head * (end - begin) * self._step_s / self._site.a1
        put_back = self._level + np.cumsum(pumped) - pumped
        means = np.bincount(self._number, put_back * self._counts) / self._sizes
        return np.where(self._counts, put_back - means[self._number], 0.0)

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
        weights = np.ones(len(self._sizes))
        for rounds in range(_MOST_ROUNDS):
            root = np.sqrt(weights)[self._number]
            solution: OptimizeResult = least_squares(
                lambda near, root=root: root * self.residuals(near), at,
                jac=lambda near, root=root: root[:, None] * self.jacobian(near),
                bounds=(low, high),
            )
            at = solution.x
            squares = np.bincount(self._number, self.residuals(at) ** 2)
            size = np.sqrt(squares / (self._sizes - 1))
            typical = max(float(np.median(size)), _LEAST_M)
            relative = size / typical
            before, weights = weights, np.maximum(1 - (relative / _BIWEIGHT) ** 2, 0.0) ** 2
            if rounds < _HUBER_ROUNDS:
                weights = 1 / np.maximum(relative, 1.0)
            elif np.max(np.abs(weights - before)) < _SETTLED:
                break
        counts = root > 0
        jacobian, groups = solution.jac[counts], self._number[counts]
        moved = moves(jacobian, solution.fun[counts], groups)
        return _Solution(at, at + moved, freedom(jacobian, groups), typical)


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
    offset does not count, and its noise is of all levels of a run. How much the pump state is
    late or early is fitted, too: the levels before and after show when the cistern falls.

    Runs in which the cistern rises by more than its noise are left out, and others count less the
    less they fit (Tukey's biweight, of a run's residuals over the median run's). Intervals
    are by :func:`.fit.half_intervals`, with runs as groups, and as many
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
    if len(runs) < _FEWEST_RUNS:
        return unseen
    standing = standing_steps(record.step_s)
    all_count = np.full(record.steps, True)
    fall = _Fall(site, record.step_s, command, cistern, runs, all_count)
    coarse = fall.solve(3, standing + 1)
    delay, share = coarse.shares[:2].tolist()
    if not 1 / _BELIEVABLE < share < _BELIEVABLE:
        return PumpFit(site, (), [FINDINGS.make(
            "unit-error", "pump", "cistern level", flow=1000 * fall.most * share,
            curve=1000 * fall.most,
        )])
    if abs(delay) > standing + 0.5 and coarse.half[1] < _HARDLY * share:
        return PumpFit(site, (), [FINDINGS.make(
            "clock-shifted", "pump", "pump state", minutes=standing * record.step_s / 60,
            side="after" if delay > 0 else "before",
        )])
    late = round(delay)
    # The command as it was so many steps earlier.
    command = np.pad(command, abs(late), constant_values=np.nan)[abs(late) + late:][:len(command)]
    # The levels at which pumps start or stop do not count: the least part of a step by which the
    # pump state is late moves one of both, whichever the noise prefers, and the flow is too large.
    counts = ~np.append(False, np.diff(command > 0))
    runs = [
        run for run in find_runs(site, record, command, cistern)
        if np.count_nonzero(counts[run]) >= _FEWEST_LEVELS
    ]
    every = len(runs)
    runs = [run for run in runs if greatest_rise(cistern[run]) <= _RISE * coarse.size]
    if len(runs) < _FEWEST_RUNS:
        return unseen
    fall = _Fall(site, record.step_s, command, cistern, runs, counts)
    fitted = fall.solve(3, 1)
    share = min(fitted.shares[2], 1.0)
    told_apart = fall.derived(fitted.shares)[1] < 0 and fitted.half[2] < _HARDLY * share
    if not told_apart:
        fitted = fall.solve(2, 1)
    flow, a_hat, c_hat = fall.derived(fitted.shares).tolist()
    half = half_intervals(fall.derived(fitted.others), fitted.freedom[[1, -1, -1]]).tolist()
    shape = Parameter("a_hat", a_hat, a_hat - half[1], a_hat + half[1], "")
    if not told_apart:
        shape = Parameter(
            "a_hat", site.a_hat, np.nan, np.nan, "the data cannot tell it apart from c_hat"
        )
    height = Parameter("c_hat", c_hat, c_hat - half[2], c_hat + half[2], "")
    count = len(fitted.others)
    delay = late + float(fitted.shares[0])
    findings = [FINDINGS.make(
        "pumps", "flow", "pumps", flow=1000 * flow, half=1000 * half[0], level=fall.middle,
        runs=count, late_s=delay * record.step_s, late_half_s=float(fitted.half[0] * record.step_s),
    )]
    if every > count:
        findings.append(FINDINGS.make("pumps", "left out", "pumps", runs=every - count))
    if abs(delay) >= _NAMED:
        findings.append(FINDINGS.make(
            "pumps", "shifted", "pumps", minutes=abs(delay) * record.step_s / 60,
            side="late" if delay > 0 else "early",
        ))
    # A logger that writes what it sees once a step makes runs longer or shorter by up to a step;
    # and of those shorter than a step it sees the longer ones more often.
    steps = float(np.quantile([np.count_nonzero(command[run] > 0) for run in runs], 0.9))
    if steps <= _SHORT:
        findings.append(FINDINGS.make("pumps", "short", "pumps", steps=steps))
    return PumpFit(replace(site, a_hat=shape.value, c_hat=c_hat), [shape, height], findings)
