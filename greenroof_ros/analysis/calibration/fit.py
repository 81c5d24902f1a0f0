"""The fit of a roof to a record: the parameters that the record identifies, and their intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.record import COMBINE
from greenroof_ros.analysis.calibration.simulation import Simulated, find_min_reading, simulate
from greenroof_ros.analysis.calibration.step_record import StepRecord, Steps, Values, name_time
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

UpdateProgress = Callable[[str, float], None]
"""callback that receives a text about the current stage, and the share of stages done, 0 to 1"""

_STAGES = (
    "identification of parameters", "start of the search", "search",
    "identification at the solution", "final search",
)
# Duration of sums (s): shorter ones show the sensors' resolution, longer ones lose the peaks.
_SUM_S = 3600
# A simulation spreads a step's rain evenly, so it leaves the drainage layer later than real showers
# do. If single steps were compared, the fit would compensate with more total runoff: a third more
# with steps of six hours. In sums over this many steps, the delay does not matter. But in a record
# of days, there are too few sums longer than this (s).
_SUM_STEPS, _MAX_SUM_S = 8, 4 * 86400
# The residuals of a week form a group: a storm's effect on a roof is gone after about a week.
_WEEK_S = 7 * 86400
# In standard deviations of the measurements: beyond this the loss grows in proportion to a
# residual, no longer with its square.
_ROBUST_FROM = 10.0
# A parameter is not identified if its diagonal of the pivoted QR, relative to the largest, is below
# this.
_UNIDENTIFIED = 1e-3
# The coarse grid: shares of the ranges at which the search can begin.
_GRID = {
    "field_capacity": (0.2, 0.45, 0.7),
    "crop_coefficient": (0.1, 0.25, 0.45, 0.7),
    "depletion_fraction": (0.3, 0.85),
}
_STEP = 1e-3
_MAX_EVALUATIONS = 60
# With longer steps (s) the drainage time is not fitted: it would compensate for the even rain.
_DRAINAGE_STEP_S = 3600
_HARDLY = 0.5
"""If half an interval exceeds this share of the value or range, the data hardly constrain it."""
_END = 0.005
_CONFIDENCE = 0.95
# A group with more than this share of the information about a parameter determines it alone.
_ALONE = 0.99
FILLED = "filled"
# Share of the available water that is on the roof at first, if nothing is known about it.
_HALF_FILLED = 0.5
_DRAINAGE = "drainage_time"


@dataclass(frozen=True)
class FitRange:
    """The range of a parameter that is fitted.

    Attributes:
        name: name of a site's parameter, or ``filled``: the share of the available water capacity
            that is filled when the record begins.
        low: minimum value.
        high: maximum value.
        logarithmic: whether the scale of the range is logarithmic.
    """

    name: str
    low: float
    high: float
    logarithmic: bool = False

    def share(self, value: float) -> float:
        """Return the position of a value within the range, from 0 to 1."""
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def value(self, share: float) -> float:
        """Return the value at a share of the range; the inverse of :meth:`share`."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))


def list_ranges(site: Site, record: StepRecord) -> list[FitRange]:
    """Return the ranges of the parameters to fit.

    The ranges of field capacity and wilting point do not overlap; the driest level, if measured,
    separates them. The drainage layer's storage is not fitted: while the layer is not full, its
    outflow k V^2 depends only on the product of storage and time constant. With steps longer than
    an hour, the layer's time constant is not fitted either.
    """
    if record.level is None:
        highest = max(0.1, (site.wilting_point or 0.0) + 0.01)
    else:
        driest = float(np.nanquantile(record.level, 0.01)) / site.z_soil + 0.02
        highest = min(0.3, max(0.03, driest))
    drainage = FitRange(_DRAINAGE, 10.0, 2e4, logarithmic=True)
    return [
        FitRange("field_capacity", highest + 0.01, 0.9),
        FitRange("wilting_point", 0.0, highest),
        FitRange("depletion_fraction", 0.0, 0.95),
        *([drainage] if record.step_s <= _DRAINAGE_STEP_S else []),
        FitRange("crop_coefficient", 0.1, 2.5),
        FitRange(FILLED, 0.0, 1.0),
    ]


# In m: drainage mats and gravel have 0.002 to 0.04. An ordinary storm does not fill it.
_TYPICAL_STORAGE = 0.02


def complete_roof(site: Site) -> Site:
    """Return a site with field-capacity soil, using typical values for missing parameters."""
    if site.field_capacity is None:
        site = replace(
            site, field_capacity=0.35, wilting_point=0.02, depletion_fraction=0.5,
            z_cap=site.a2 * site.z_soil * 0.35,
        )
    if site.drainage_storage is None:
        site = replace(site, drainage_storage=_TYPICAL_STORAGE, drainage_time=600.0)
    return site


# Share of the plants' available water that may be used up: 'a value of 0.50 for p is commonly used
# for many crops' (FAO-56, chapter 8).
_DEPLETION = 0.5


def lower_target(site: Site) -> Site:
    """Return the site, with a lower target if its roof cannot hold the current target.

    Water above field capacity drains, so the pumps would never reach a target above it. Because a
    record says nothing about the target, the target is set half-way between wilting point and field
    capacity, and the site's owner is asked to choose another target.

    Args:
        site: site with field-capacity soil.
    """
    if site.x2_star < site.z_cap:
        return site
    volume = site.wilting_volume + (1 - _DEPLETION) * site.available_volume
    depth = float(f"{volume / site.a2:.6g}")  # with as many digits as the site file
    return replace(site, z_veg=depth, x2_star=site.a2 * depth)


class FittedParameter(NamedTuple):
    """A fitted parameter."""

    name: str
    value: float
    low: float
    """end of the 95 % interval; NaN if the data do not determine it"""
    high: float
    reason: str
    """reason why it was not fitted, or is uncertain; empty if the data determine it"""

    @property
    def interval(self) -> str:
        """The 95 % interval as text; empty if the data do not determine the parameter."""
        return "" if np.isnan(self.low) else f"{self.low:.4g} to {self.high:.4g}"


class Fit(NamedTuple):
    """A site fitted to a record."""

    site: Site
    parameters: list[FittedParameter]
    simulated: Simulated
    """the whole record as simulated, as its meter would show it"""


def fit(
    site: Site, record: StepRecord, steps: Steps,
    update_progress: UpdateProgress = lambda text, share: None, start: Fit | None = None,
) -> Fit:
    """Fit field-capacity soil to selected steps of a record.

    The simulated sums of runoff and means of the level are fitted to the measured values by least
    squares within bounds. Each sum or mean covers an hour, or eight steps (but no more than four
    days) if these are longer, because a simulated step spreads its rain evenly. Beyond ten standard
    deviations of the measurements, the loss grows only linearly ("soft_l1"), so that a broken
    sensor does not dominate. For the comparison, the simulated values are converted to what the
    record's meter would show. The search begins at the best point of a coarse grid, or at another
    fit if this is better.

    Parameters that the record does not identify keep the site's values: the drainage time if steps
    are longer than an hour, and any parameter whose column of the Jacobian, scaled by the
    parameter's range, is small or a linear combination of other columns (QR with column pivoting;
    Golub and Van Loan, Matrix Computations, 5.5.7). Intervals come from :func:`compute_intervals`,
    with weeks as groups. Each parameter's interval is widened by the largest effect that changing
    the fixed parameters within their ranges has on this parameter.

    Args:
        site: site that provides the start of the search and the values of the fixed parameters.
        record: the measurements.
        steps: steps that are compared; the roof is simulated over all steps.
        update_progress: callback that receives the progress before every simulation.
        start: a fit of a similar site to the same record.
    """
    site = complete_roof(site)
    every = list_ranges(site, record)
    as_it_was = np.array([span.share(getattr(site, span.name, _HALF_FILLED)) for span in every])
    at = np.clip(as_it_was, 0.01, 0.99)
    residuals, weeks = _make_comparison(record, steps)
    stage, simulations = 0, itertools.count(1)
    minimum = find_min_reading(record)

    def simulated(shares: Values, minimum: float) -> tuple[Site, Simulated]:
        values = {span.name: span.value(share) for span, share in zip(every, shares, strict=True)}
        filled = values.pop(FILLED)
        z_cap = site.a2 * site.z_soil * values["field_capacity"]
        fitted = replace(site, z_cap=z_cap, **values)  # type: ignore[arg-type]
        return fitted, simulate(fitted, record, filled, minimum)

    def differences(shares: Values, minimum: float = minimum) -> Values:
        update_progress(
            f"{stage + 1} of {len(_STAGES)}: {_STAGES[stage]}, {next(simulations)} simulations",
            stage / len(_STAGES),
        )
        return residuals(simulated(shares, minimum)[1])

    def jacobian() -> Values:
        """Return the derivatives of the residuals with respect to the shares, shape (n, ranges).

        The minimum reading of the meter is ignored, because it turns a smooth simulation into
        steps. A small difference across a few of these steps would make a parameter look
        identified, or equal columns look different.
        """
        base = differences(at, 0.0)
        columns = []
        for place, share in enumerate(at):
            moved = at.copy()
            moved[place] += _STEP if share < 0.5 else -_STEP
            columns.append((differences(moved, 0.0) - base) / (moved[place] - share))
        return np.column_stack(columns)

    from scipy.optimize import least_squares  # half a second; not needed for rejected records

    def solve() -> OptimizeResult:
        def moved(shares: Values) -> Values:
            near = at.copy()
            near[free] = shares
            return differences(near)

        solution = least_squares(
            moved, at[free], bounds=(0.0, 1.0), diff_step=_STEP, loss="soft_l1",
            f_scale=_ROBUST_FROM, xtol=1e-8, ftol=1e-9, max_nfev=_MAX_EVALUATIONS,
        )
        at[free] = solution.x
        return solution

    names = [span.name for span in every]
    free, _ = _identify(names, jacobian())
    # Between a large store with little evaporation and a small store with much, there is a ridge
    # that no search crosses.
    grid = itertools.product(*(
        _GRID.get(span.name, (share,)) if is_free else (share,)
        for span, share, is_free in zip(every, at, free, strict=True)
    ))
    starts = [at, *map(np.array, grid)]
    if start is not None:
        found = {parameter.name: parameter.value for parameter in start.parameters}
        starts.append(np.array([span.share(found[span.name]) for span in every]))
    stage = 1
    at = min(starts, key=lambda shares: _compute_cost(differences(shares)))
    stage = 2
    solve()
    # Again at the solution: it may identify parameters other than those at the start of the search.
    stage = 3
    free, why = _identify(names, jacobian())
    at[~free] = as_it_was[~free]
    stage = 4
    solution = solve()
    # Rows and residuals are scaled for the robust loss as in scipy's least_squares: their product
    # is the gradient, in which a residual has the weight (1 + z)^(-1/2).
    robust = 1 + (solution.fun / _ROBUST_FROM) ** 2
    rows = jacobian() * robust[:, None] ** -0.75
    half = np.full(len(every), np.nan)
    # How far the fitted parameters follow each held one to the more distant end of its range.
    follows = np.linalg.lstsq(rows[:, free], rows[:, ~free], rcond=None)[0]
    shift = np.linalg.norm(follows * np.maximum(at[~free], 1 - at[~free]), axis=1)
    own = compute_intervals(rows[:, free], solution.fun * robust**0.25, weeks)
    half[free] = np.hypot(own, shift)
    parameters = list(map(_judge, every, at.tolist(), half.tolist(), why))
    if record.step_s > _DRAINAGE_STEP_S:
        assert site.drainage_time is not None
        reason = f"steps of {name_time(record.step_s)} are too long to identify this parameter"
        parameters.insert(3, FittedParameter(_DRAINAGE, site.drainage_time, np.nan, np.nan, reason))
    fitted, shown = simulated(at, minimum)
    update_progress("done", 1.0)
    return Fit(fitted, parameters, shown)


def _compute_cost(residuals: Values) -> float:
    """Return the loss that the search minimizes, apart from a constant factor."""
    return float(np.sum(np.sqrt(1 + (residuals / _ROBUST_FROM) ** 2) - 1))


def _make_comparison(
    record: StepRecord, steps: Steps
) -> tuple[Callable[[Simulated], Values], NDArray[np.int64]]:
    """Return a function that computes a simulation's residuals, and the week of every residual.

    Residuals are expressed in standard deviations of the measurements.
    """
    counts = steps & record.complete
    seconds = record.seconds[counts]
    span_s = max(_SUM_S, min(_SUM_STEPS * round(record.step_s), _MAX_SUM_S))

    def together(series: Mapping[str, Values]) -> list[Values]:
        return [COMBINE[name](series[name][counts], seconds, span_s) for name in record.measured]

    measured = together(record.measured)
    spread = [float(np.std(series)) or 1.0 for series in measured]

    def residuals(simulated: Simulated) -> Values:
        pairs = zip(together(simulated._asdict()), measured, spread, strict=True)
        return np.concatenate([(shown - target) / scale for shown, target, scale in pairs])

    begin = np.unique(seconds // span_s) * span_s
    return residuals, np.tile(begin // _WEEK_S, len(measured))


def _identify(names: Sequence[str], jacobian: Values) -> tuple[Steps, list[str]]:
    """Return a mask of the identified parameters, and why the others are not identified."""
    from scipy.linalg import qr

    _, triangle, order = qr(jacobian, mode="economic", pivoting=True)
    # With fewer residuals than parameters, no more parameters than residuals are identified.
    size = np.zeros(len(names))
    size[order[:len(triangle)]] = np.abs(np.diag(triangle))
    free = size > _UNIDENTIFIED * size.max()
    lengths = np.linalg.norm(jacobian, axis=0)
    why = [""] * len(names)
    for place in np.flatnonzero(~free).tolist():
        if lengths[place] <= _UNIDENTIFIED * size.max():
            why[place] = "the data do not depend on this parameter"
            continue
        weights = np.linalg.lstsq(jacobian[:, free], jacobian[:, place], rcond=None)[0]
        alike = np.flatnonzero(free)[np.abs(weights) * lengths[free] > 0.1 * lengths[place]]
        others = " and ".join(names[other] for other in alike)
        why[place] = f"the data cannot distinguish this parameter from {others}"
    return free, why


def _judge(parameter: FitRange, share: float, half: float, why: str) -> FittedParameter:
    """Return a parameter with its interval, and the reason if the parameter is uncertain.

    Args:
        parameter: name and range of the parameter.
        share: value of the parameter, as a share of the range.
        half: half-width of the interval, as a share of the range; NaN if the data do not determine
            the parameter.
        why: reason why the data do not determine the parameter.
    """
    value = parameter.value(share)
    if math.isnan(half):
        return FittedParameter(parameter.name, value, half, half, why)
    low, high = (parameter.value(max(0.0, min(1.0, end))) for end in (share - half, share + half))
    reason = ""
    if not _END < share < 1 - _END:
        reason = f"at the limit of its range ({parameter.low:.3g} to {parameter.high:.3g})"
    elif high - low > _HARDLY * 2 * abs(value) or half > _HARDLY:
        reason = "the data hardly constrain this parameter"
    return FittedParameter(parameter.name, value, low, high, reason)


def compute_intervals(
    jacobian: Values, residuals: Values, groups: NDArray[np.int64]
) -> Values:
    """Return the half-width of every parameter's 95 % interval.

    The method is Tukey's jackknife (Efron 1982, doi:10.1137/1.9781611970319) with Student's t. The
    fit is treated as linear: leaving out a group with residuals r_g and Jacobian J_g moves the
    parameters by (J'J - J_g'J_g)^-1 J_g' r_g. If few groups contain most of the information about a
    parameter, its variance is less certain. The degrees of freedom are Kish's effective number of
    groups minus one, sum(w)^2 / sum(w^2) - 1, where w is the information that is lost without a
    group; they are at least 1. If all groups are equal, the degrees of freedom are the number of
    groups minus one. If one group alone determines nearly everything about a parameter, nothing
    shows how the parameter would vary, and the half-width of its interval is infinite.

    Args:
        jacobian: Jacobian at the fit, shape (n, parameters).
        residuals: residuals at the fit, shape (n,).
        groups: index of the group to which each residual belongs, shape (n,). Residuals in one
            group may depend on each other.
    """
    from scipy.stats import t as student  # half of the import time; not for rejected records

    moved, kept = [], []
    for group in np.unique(groups):
        own = groups == group
        rest = jacobian[~own]
        moved.append(np.linalg.pinv(rest.T @ rest) @ (jacobian[own].T @ residuals[own]))
        kept.append(_measure_information(rest))
    whole = _measure_information(jacobian)
    lost = whole - kept
    degrees = np.maximum(1.0, lost.sum(axis=0) ** 2 / np.sum(lost**2, axis=0) - 1)
    variance = np.var(moved, axis=0) * (len(moved) - 1)
    half = student.ppf((1 + _CONFIDENCE) / 2, degrees) * np.sqrt(variance)
    return np.where(lost.max(axis=0) >= _ALONE * whole, np.inf, half)


def _measure_information(jacobian: Values) -> Values:
    """Return each parameter's information: squares of its column not explained by other columns.

    Args:
        jacobian: Jacobian, shape (n, parameters).
    """
    unexplained = []
    for place, column in enumerate(jacobian.T):
        others = np.delete(jacobian, place, axis=1)
        unexplained_part = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
        unexplained.append(float(unexplained_part @ unexplained_part))
    return np.array(unexplained)
