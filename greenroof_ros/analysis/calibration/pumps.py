"""The pumps of a site, fitted to the fall of the cistern's level while they run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.checks import FINDINGS
from greenroof_ros.analysis.calibration.fit import (
    HARDLY,
    FittedParameter,
    freedom,
    half_intervals,
    moves,
)
from greenroof_ros.analysis.calibration.record import (
    RoofRecord,
    Steps,
    Values,
    greatest_rise,
    prolonged,
)
from greenroof_ros.common.quality import Finding
from greenroof_ros.formats.records import gaps
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

# For this long after rain the catchment still feeds the cistern (s). At this distance from the
# levels of outlet, valve and suction a sensor's noise does not matter (m).
_WET_S = 3600
_MARGIN_M = 0.05
_STANDING_STEPS, _STANDING_S = 2, 600
_FEWEST_LEVELS = 3
_FEWEST_RUNS = 10
# Tukey's biweight, in typical residuals: 95 % efficient for normal residuals (Holland and Welsch
# 1977, doi:10.1080/03610927708827533). Huber's weights come first: they have a unique solution.
_BIWEIGHT = 4.685
_HUBER_ROUNDS, _MOST_ROUNDS, _SETTLED = 5, 50, 1e-3
# For shares: the step of derivatives, and the minimum value.
_SHARE, _MIN_SHARE = 1e-4, 1e-3
# The minimum typical residual: no level is known better than this (m).
_MIN_M = 1e-4
# A larger rise, in typical residuals, is not noise: two levels of white noise are this far apart
# once in a million times.
_RISE = 7.0
# In steps: the minimum delay to report, and runs too short to distinguish from shorter ones.
_NAMED, _SHORT = 0.5, 2
# No pump lifts this many times the flow of its curve, or less than that flow over this.
_BELIEVABLE = 10.0


def standing_steps(step_s: float) -> int:
    """Return how many steps before and after a run its levels count.

    The pump state can be late or early by this much: a logger's by a step or two, a drive's by
    minutes.
    """
    return max(_STANDING_STEPS, round(_STANDING_S / step_s))


def find_runs(
    site: Site, record: RoofRecord, command: Values, cistern: Values
) -> list[NDArray[np.int64]]:
    """Return the pump runs in which only the pumps change the cistern's level.

    A run is an array of steps, from before the pumps' start to after their stop; its levels are at
    the beginning of each step. The steps are those without rain for an hour, with a level between
    the outlet and the levels of suction and mains valve, and without missing values. Two runs that
    are near each other share the levels between them equally.
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
    site: Site, record: RoofRecord, command: Values, level: Values, standing: int
) -> Steps:
    """Return the steps in which only the pumps change the cistern's level."""
    recent = prolonged(~(record.rain == 0), round(_WET_S / record.step_s) + 1)
    reach = standing + 2
    unknown = np.convolve(np.isnan(command), np.ones(2 * reach + 1), "same") > 0
    low = max(site.suction_level, site.mains_level or 0.0) + _MARGIN_M
    between = (level > low) & (level < site.lowest_outlet - _MARGIN_M)
    return np.asarray(between & np.append(between[1:], False) & ~recent & ~unknown)


class _Solution(NamedTuple):
    """The result of fitting shares."""

    shares: Values
    others: Values
    """the shares as fitted without each run, shape (runs, shares)"""
    freedom: Values
    """degrees of freedom of each share's interval"""
    size: float
    """residual of the median run (m), among all runs, even those with no weight"""

    @property
    def half(self) -> Values:
        """Half of each share's interval."""
        return half_intervals(self.others, self.freedom)


class _CisternFall:
    """The cistern's levels during runs, as a function of the shares that are fitted.

    Shares are the delay of the pump state in steps, the flow as a share of the site's and, if there
    is a third, 1 / H as a share of the site's. With two shares, ``a_hat`` is held and gives H.
    """

    def __init__(
        self, site: Site, step_s: float, command: Values, cistern: Values,
        runs: Sequence[NDArray[np.int64]], counts: Steps,
    ) -> None:
        """Store the levels of all runs (m), and for each step whether its level counts."""
        self._site, self._step_s = site, step_s
        self._step = np.concatenate(runs)
        self._number = np.repeat(np.arange(len(runs)), [len(run) for run in runs])
        self._counts = counts[self._step]
        self._sizes = np.bincount(self._number, self._counts)
        self._level = level = cistern[self._step]
        # Mean of each level and the next; the last level of a run is used alone.
        last = np.append(self._number[1:] != self._number[:-1], True)
        self._between = np.where(last, level, (level + np.append(level[1:], 0.0)) / 2)
        self._total = np.concatenate(([0.0], np.cumsum(np.nan_to_num(command))))
        self.middle = float(np.average(self._between, weights=command[self._step]))
        self.most = maximum_pump_flow(site, self.middle * site.a1)
        self._head = self.middle + site.c_hat - site.d

    def residuals(self, shares: Values) -> Values:
        """Return the levels of each run plus the pumped depth, less their mean in the run (m)."""
        slope = (shares[2] if len(shares) > 2 else shares[1] ** -2) / self._head
        head = np.sqrt(np.maximum(1 + slope * (self._between - self.middle), 0.0))
        steps = np.arange(len(self._total))
        begin, end = (
            np.interp(self._step + later + shares[0], steps, self._total) for later in (0, 1)
        )
        pumped = self.most * shares[1] * head * (end - begin) * self._step_s / self._site.a1
        restored = self._level + np.cumsum(pumped) - pumped
        means = np.bincount(self._number, restored * self._counts) / self._sizes
        return np.where(self._counts, restored - means[self._number], 0.0)

    def jacobian(self, shares: Values) -> Values:
        """Return the derivatives of residuals by the shares, shape (n, shares).

        By the delay, slopes differ on the two sides of a whole step; this is their mean.
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
        """Fit two or three shares, with less weight on runs that fit less well.

        Args:
            shares: number of shares.
            latest: largest delay or lead of the pump state, in steps.
        """
        from scipy.optimize import least_squares

        low = np.array([-latest, *[_MIN_SHARE] * 2])[:shares]
        high = np.array([latest, *[1 / _MIN_SHARE] * 2])[:shares]
        at = np.array([0.0, 1.0, 1.0])[:shares]
        weights = np.ones(len(self._sizes))
        for rounds in range(_MOST_ROUNDS):
            root = np.sqrt(weights)[self._number]
            solution = least_squares(
                lambda near, root=root: root * self.residuals(near), at,
                jac=lambda near, root=root: root[:, None] * self.jacobian(near),
                bounds=(low, high),
            )
            at = solution.x
            squares = np.bincount(self._number, self.residuals(at) ** 2)
            size = np.sqrt(squares / (self._sizes - 1))
            typical = max(float(np.median(size)), _MIN_M)
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
    """The pumps as fitted to the cistern's levels."""

    site: Site
    """with the fitted curve; unchanged if the record does not identify it"""
    parameters: Sequence[FittedParameter]
    """``a_hat`` and ``c_hat``; empty if the record does not identify them"""
    findings: Sequence[Finding]
    """the flow, what the record leaves open, or why the record must be wrong"""


def fit_pumps(site: Site, record: RoofRecord) -> PumpFit:
    """Fit the pump curve to the fall of the cistern while the pumps run and nothing flows in.

    At command 1 and a level z they lift, by Eqs. (3b)-(3e),

        q(z) = Q sqrt(1 + (z - Z) / H),  H = Z + c_hat - d,  Q^2 = H / (pipe_resistance - a_hat),

    with Z the mean level. Q is the flow at Z, and H describes how it depends on the level. At a
    command below 1 they lift that share of q. The levels of each run, with some time before and
    after it, are fitted by least squares after their mean is removed. So a sensor's offset does not
    matter, and its noise averages over all levels of a run. The delay of the pump state is also
    fitted: the levels before and after a run show when the cistern falls.

    Runs in which the cistern rises by more than noise are left out. The others have less weight the
    less they fit (Tukey's biweight, of a run's residuals over the median run's). Intervals are by
    :func:`.fit.half_intervals`, with runs as groups and the degrees of :func:`.fit.freedom`.

    If the cistern's fall is far from what the pumps can lift, or at another time than they run, the
    findings hold a refusal and no curve is fitted. With fewer than ten runs that count, of those
    by :func:`find_runs`, no curve is fitted either.

    If levels change the head by too little to identify H, ``a_hat`` is held, and ``c_hat`` follows
    from Q alone.

    Args:
        site: its cistern and pipe, and the curve that is held if the data do not identify it.
        record: the measurements; without a command or a cistern level nothing is found.
    """
    command, cistern = record.command, record.cistern
    if command is None or cistern is None:
        return PumpFit(site, (), ())
    unseen = PumpFit(site, (), [FINDINGS.make("pumps", "unseen", "pumps")])
    runs = find_runs(site, record, command, cistern)
    if len(runs) < _FEWEST_RUNS:
        return unseen
    standing = standing_steps(record.step_s)
    fall = _CisternFall(site, record.step_s, command, cistern, runs, np.full(record.steps, True))
    coarse = fall.solve(3, standing + 1)
    delay, share = coarse.shares[:2].tolist()
    if not 1 / _BELIEVABLE < share < _BELIEVABLE:
        return PumpFit(site, (), [FINDINGS.make(
            "unit-error", "pump", "cistern level", flow=1000 * fall.most * share,
            curve=1000 * fall.most,
        )])
    if abs(delay) > standing + 0.5 and coarse.half[1] < HARDLY * share:
        return PumpFit(site, (), [FINDINGS.make(
            "clock-shifted", "pump", "pump state", minutes=standing * record.step_s / 60,
            side="after" if delay > 0 else "before",
        )])
    late = round(delay)
    # The command of this many steps earlier.
    command = np.pad(command, abs(late), constant_values=np.nan)[abs(late) + late:][:len(command)]
    # Levels at which pumps start or stop do not count. If the pump state is late by a small part of
    # a step, the fit moves one of the two, as the noise suggests, and the flow becomes too large.
    counts = ~np.append(False, np.diff(command > 0))
    runs = [
        run for run in find_runs(site, record, command, cistern)
        if np.count_nonzero(counts[run]) >= _FEWEST_LEVELS
    ]
    every = len(runs)
    runs = [run for run in runs if greatest_rise(cistern[run]) <= _RISE * coarse.size]
    if len(runs) < _FEWEST_RUNS:
        return unseen
    fall = _CisternFall(site, record.step_s, command, cistern, runs, counts)
    fitted = fall.solve(3, 1)
    share = min(fitted.shares[2], 1.0)
    identified = fall.derived(fitted.shares)[1] < 0 and fitted.half[2] < HARDLY * share
    if not identified:
        fitted = fall.solve(2, 1)
    flow, a_hat, c_hat = fall.derived(fitted.shares).tolist()
    half = half_intervals(fall.derived(fitted.others), fitted.freedom[[1, -1, -1]]).tolist()
    shape = FittedParameter("a_hat", a_hat, a_hat - half[1], a_hat + half[1], "")
    if not identified:
        shape = FittedParameter(
            "a_hat", site.a_hat, np.nan, np.nan, "the data cannot tell it apart from c_hat"
        )
    height = FittedParameter("c_hat", c_hat, c_hat - half[2], c_hat + half[2], "")
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
    # A logger that samples the pump state once a step makes runs longer or shorter by up to a step,
    # and it sees more of the longer ones among runs shorter than a step.
    steps = float(np.quantile([np.count_nonzero(command[run] > 0) for run in runs], 0.9))
    if steps <= _SHORT:
        findings.append(FINDINGS.make("pumps", "short", "pumps", steps=steps))
    return PumpFit(replace(site, a_hat=shape.value, c_hat=c_hat), [shape, height], findings)
