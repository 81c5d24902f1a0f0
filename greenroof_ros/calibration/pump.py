"""The pumps of a site, from how fast their cistern falls while they run."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from greenroof_ros.calibration.fit import Parameter
from greenroof_ros.calibration.intervals import freedom, half_intervals, moves
from greenroof_ros.calibration.pump_runs import Runs, find_runs, standing_steps
from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site

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


class PumpFit(NamedTuple):
    """The pumps as the cistern shows them."""

    site: Site
    """with their curve"""
    parameters: list[Parameter]
    """``a_hat`` and ``c_hat``"""
    flow: float
    """at command 1 and the level below (m3/s)"""
    half: float
    """half of the flow's 95 % interval (m3/s)"""
    level: float
    """of the cistern, the mean while they ran (m)"""
    runs: int
    """that count"""
    left_out: int
    """runs in which something else moved the cistern"""
    late: float
    """of the pump state, after the cistern's fall (s)"""
    late_half: float
    """half of its 95 % interval (s)"""
    words: list[str]
    """what the record leaves open, or what its logger does"""


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


def fit_pump(site: Site, record: Record) -> PumpFit | None:
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
    are those of :mod:`greenroof_ros.calibration.intervals`, with runs as groups, and as many
    degrees of freedom as the runs have together.

    Where levels change the head by too little to tell H, ``a_hat`` stays as it is, and ``c_hat``
    follows from Q alone.

    Args:
        site: its cistern and pipe, and the curve that is held where the data do not tell it.
        record: what was measured.

    Returns:
        None where the record has no command or no level of the cistern, or fewer than ten runs
        that count, by :func:`greenroof_ros.calibration.pump_runs.find_runs`.

    Raises:
        ConfigurationError: the cistern falls by nothing like what the pumps can lift, or at another
            time than they run.
    """
    command, cistern = record.command, record.cistern
    if command is None or cistern is None:
        return None
    runs = find_runs(site, record, command, cistern)
    if len(runs.sizes) < _FEWEST_RUNS:
        return None
    standing = standing_steps(record.step_s)
    coarse = _Fall(site, record, command, runs).solve(3, standing + 1)
    _refuse_unlike(record, coarse, standing)
    late = round(coarse.shares[0])
    command = _earlier(command, late)
    runs = find_runs(site, record, command, cistern)
    runs = runs.without(_edges(command)[runs.step])
    every = len(runs.sizes)
    runs = runs.only(runs.rises() <= _RISE * max(float(np.median(coarse.size)), _LEAST_M))
    if len(runs.sizes) < _FEWEST_RUNS:
        return None
    fall = _Fall(site, record, command, runs)
    found = fall.solve(3, 1)
    shape_told = (
        fall.derived(found.shares)[1] < 0 and found.half[2] < _HARDLY * min(found.shares[2], 1.0)
    )
    if not shape_told:
        found = fall.solve(2, 1)
    flow, a_hat, c_hat = fall.derived(found.shares).tolist()
    half = half_intervals(fall.derived(found.others), found.freedom[[1, -1, -1]]).tolist()
    shape = Parameter("a_hat", a_hat, a_hat - half[1], a_hat + half[1], "")
    if not shape_told:
        shape = Parameter(
            "a_hat", site.a_hat, np.nan, np.nan, "the data cannot tell it apart from c_hat"
        )
    height = Parameter("c_hat", c_hat, c_hat - half[2], c_hat + half[2], "")
    fitted = replace(site, a_hat=shape.value, c_hat=c_hat)
    return PumpFit(
        fitted, [shape, height], flow, half[0], fall.middle, len(found.others),
        every - len(found.others), (late + found.shares[0]) * record.step_s,
        found.half[0] * record.step_s, _words(record, command, runs, late + found.shares[0]),
    )


def _earlier(command: Values, steps: int) -> Values:
    """Return a command as it was some steps earlier; NaN where the record has none."""
    padded = np.pad(command, abs(steps), constant_values=np.nan)
    return padded[abs(steps) + steps:][:len(command)]


def _edges(command: Values) -> NDArray[np.bool_]:
    """Return the levels at which pumps start or stop.

    The least part of a step by which the pump state is late moves one of both, whichever the noise
    prefers: they would make the flow too large.
    """
    runs = command > 0
    return np.append(False, runs[1:] != runs[:-1])


def _words(record: Record, command: Values, runs: Runs, late: float) -> list[str]:
    """Say if the pump state is late or early, and if runs are too short to say how long they are.

    A logger that writes what it sees once a step makes runs longer or shorter by up to a step; and
    of those shorter than a step it sees the longer ones more often.
    """
    words = []
    minutes = late * record.step_s / 60
    if abs(late) >= _NAMED:
        words.append(
            f"The pump state is {abs(minutes):.2g} min {'late' if late > 0 else 'early'} against "
            "the cistern's fall"
        )
    steps = float(np.quantile(runs.lasting(command), 0.9))
    if steps <= _SHORT:
        words.append(
            f"Nine in ten runs last {steps:g} steps or less: the flow is right only if the pump "
            "state is the mean of each step, and not what was seen at one time in it"
        )
    return words


def _refuse_unlike(record: Record, found: _Solution, standing: int) -> None:
    """Refuse a fall that is not that of these pumps, or not at the time that they run."""
    late, share = found.shares[:2].tolist()
    if not 1 / _BELIEVABLE < share < _BELIEVABLE:
        raise ConfigurationError(
            f"falls while the pumps run as if they lifted {1000 * found.most * share:.2g} l/s at "
            f"full command, and by the site's curve they lift {1000 * found.most:.2g} l/s; is the "
            "sensor stuck, a unit wrong, a clock shifted, or the pump state that of other pumps?",
            file=record.source, key="cistern level",
        )
    if abs(late) > standing + 0.5 and found.half[1] < _HARDLY * share:
        raise ConfigurationError(
            f"is more than {standing * record.step_s / 60:g} min "
            f"{'after' if late > 0 else 'before'} the cistern's fall: is a clock shifted?",
            file=record.source, key="pump state",
        )
