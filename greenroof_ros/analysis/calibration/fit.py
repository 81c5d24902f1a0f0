"""The fit of field-capacity soil to a record: simulation, parameters and their intervals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.analysis.calibration.record import (
    HOUR_S,
    FitScores,
    StepRecord,
    Steps,
    Values,
    combine,
    score,
)
from greenroof_ros.physics.compiled import compiled
from greenroof_ros.physics.parameters import PlantParameters, plant_parameters
from greenroof_ros.physics.soil import layer_outflow, percolation, water_stress
from greenroof_ros.site.site import Site

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

UpdateProgress = Callable[[str, float], None]
"""callback that receives the current task, and the share that is done, 0 to 1"""

EXPONENTS = (1.0, 1.5, 2.0, 3.0, 5.0)
"""exponents that are compared, in addition to that of the site"""
ALIKE = 0.05
"""difference in the NSE of the validation up to which exponents are not told apart"""
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
_STEP = 1e-3
# A group with more than this share of the information about a parameter determines it alone.
_ALONE = 0.99
# Longest parts of steps (s): with water, within which the drainage layer's inflow hardly changes;
# and in dry weather, within which the soil's water stress hardly changes.
_WET_S, _DRY_S = 600.0, 3600.0
# Other programs may round readings to five digits: the largest error, as a share.
_DIGITS = 5e-5


def simulate(
    site: Site, record: StepRecord, filled: float, minimum: float = 0.0
) -> dict[str, Values]:
    """Simulate field-capacity soil over a record's steps.

    The result matches :func:`greenroof_ros.physics.tick.step` with short ticks, because percolation
    is solved for a whole step. Runoff is solved for a constant inflow. Therefore, steps longer than
    ten minutes are subdivided while water arrives, and steps longer than an hour are always
    subdivided. Water arrives evenly within a step. Unknown rain is treated as 0, and unknown
    evapotranspiration as the mean of the record, because a roof dries out even while its sensors
    are not working.

    Args:
        site: site with a ``field_capacity``.
        record: record of rain, pumped water and reference evapotranspiration.
        filled: share of the available water capacity that is filled at the beginning, 0 to 1.
        minimum: runoff in a step (mm) below which a meter shows 0.

    Returns:
        The measurements that the simulated roof would produce, each of shape (steps,): ``runoff``
        in every step (mm), and the water ``level`` in the substrate at its beginning (m).
    """
    volume_flow = site.a2 / 1000 / record.step_s  # m3/s for one mm per step
    water = record.water
    wet, dry = (math.ceil(record.step_s / longest) for longest in (_WET_S, _DRY_S))
    parts = np.where(water > 0, wet, dry)
    starts = np.cumsum(parts) - parts
    durations = np.repeat(record.step_s / parts, parts)
    arriving = np.repeat(water * volume_flow, parts)
    potential = np.repeat(record.drying * site.crop_coefficient * volume_flow, parts)
    volumes, flows = np.empty_like(durations), np.empty_like(durations)
    compiled(run_parts)(
        plant_parameters(site), arriving, potential, durations,
        site.wilting_volume + filled * site.available_volume, volumes, flows,
    )
    runoff = np.add.reduceat(flows * durations, starts) * 1000 / site.a2
    runoff = np.where(runoff < minimum, 0.0, runoff)
    return {"runoff": runoff, "level": volumes[starts] / site.a2}


def run_parts(
    p: PlantParameters, arriving: Values, potential: Values, durations: Values, x2: float,
    volumes: Values, flows: Values,
) -> None:
    """Simulate the parts of steps; all arrays have shape (parts,).

    Args:
        p: parameters of the plant.
        arriving: rain and pumped water (m3/s).
        potential: potential evapotranspiration from the whole bed (m3/s).
        durations: durations of the parts (s).
        x2: volume in the soil at the beginning (m3).
        volumes: array for the volume in the soil at the start of each part (m3).
        flows: array for the runoff (m3/s).
    """
    layer = 0.0
    for part in range(len(durations)):
        inflow, seconds = arriving[part], durations[part]
        volumes[part] = x2
        percolated = percolation(p, x2, inflow, seconds)
        available = x2 / seconds + inflow - percolated
        evaporated = max(0.0, min(potential[part] * water_stress(p, x2), available))
        flows[part] = layer_outflow(p, layer, percolated, seconds)
        layer = max(0.0, layer + seconds * (percolated - flows[part]))
        x2 = max(0.0, x2 + seconds * (inflow - percolated - evaporated))


def find_min_reading(record: StepRecord) -> float:
    """Return the runoff in a step (mm) below which a record's meter shows 0.

    The limit is the minimum reading above 0. A tipping bucket misses no water, because any
    remainder is carried over to the next tip. For a tipping bucket, and without a meter, the result
    is 0.
    """
    runoff = record.measured.get("runoff", np.zeros(1))
    readings = np.unique(runoff[runoff > 0])
    return 0.0 if _is_counted(readings) else float(readings[0])


def _is_counted(readings: Values) -> bool:
    """Return whether readings in ascending order are multiples of one tip, apart from rounding.

    If a reading of n tips has a rounding error of up to h, the volume of a tip is between
    (reading - h) / n and (reading + h) / n. The number n follows from the volumes of a tip that the
    earlier readings allow, because rounding can change the minimum reading by half a tip.
    """
    decimals = next((
        places for places in range(12)
        if np.allclose(np.round(readings, places), readings, rtol=1e-9, atol=0.0)
    ), 12)
    low, high = 0.0, 2 * float(readings.min(initial=np.inf))
    for reading in readings.tolist():
        off = 10.0**-decimals / 2 + _DIGITS * reading
        tips = max(1, round(2 * reading / (low + high)))
        low, high = max(low, (reading - off) / tips), min(high, (reading + off) / tips)
        if low > high:
            return False
    return True


class FitRange(NamedTuple):
    """The range of a parameter that is fitted."""

    name: str
    """name of a site's parameter"""
    low: float
    high: float
    starts: tuple[float, ...] = ()
    """shares of the range at which the search can begin, in addition to the site's value"""
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
    """Return the ranges of the site's parameters to fit.

    The ranges of field capacity and wilting point do not overlap; the driest level, if measured,
    separates them. The drainage layer's storage is not fitted: while the layer is not full, its
    outflow k V^2 depends only on the product of storage and time constant. With steps longer than
    an hour, the layer's time constant is not fitted either, because it would compensate for the
    even rain.

    The search begins at the best point of a coarse grid: between a large store with little
    evaporation and a small store with much, there is a ridge that no search crosses.
    """
    highest = max(0.1, (site.wilting_point or 0.0) + 0.01)
    if "level" in record.measured:
        driest = float(np.nanquantile(record.measured["level"], 0.01)) / site.z_soil + 0.02
        highest = min(0.3, max(0.03, driest))
    drainage = FitRange("drainage_time", 10.0, 2e4, logarithmic=True)
    return [
        FitRange("field_capacity", highest + 0.01, 0.9, (0.2, 0.45, 0.7)),
        FitRange("wilting_point", 0.0, highest),
        FitRange("depletion_fraction", 0.0, 0.95, (0.3, 0.85)),
        *([drainage] if record.step_s <= HOUR_S else []),
        FitRange("crop_coefficient", 0.1, 2.5, (0.1, 0.25, 0.45, 0.7)),
    ]


class FittedParameter(NamedTuple):
    """A fitted parameter."""

    name: str
    value: float
    low: float
    """end of the 95 % interval; NaN if the data do not determine it"""
    high: float
    reason: str
    """reason why it was not fitted, or what its interval means; empty if the data determine it"""

    @property
    def interval(self) -> str:
        """The 95 % interval as text; empty if the data do not determine the parameter."""
        return "" if np.isnan(self.low) else f"{self.low:.4g} to {self.high:.4g}"


class Fit(NamedTuple):
    """A site fitted to a half of a record."""

    site: Site
    parameters: list[FittedParameter]
    filled: float
    """share of the available water capacity that was filled when the record began"""
    simulated: dict[str, Values]
    """the whole record as simulated, as its meter would show it"""
    scores: list[FitScores]
    """scores of every quantity in either half"""

    @property
    def nse(self) -> float:
        """NSE of hours (or longer steps) in the validation, the mean over the quantities."""
        return float(np.nanmean([
            next(nse for span_s, nse in row.nse.items() if span_s >= HOUR_S)
            for row in self.scores if row.part == "validation"
        ]))


def fit(
    site: Site, record: StepRecord, halves: Mapping[str, Steps], start: Fit | None = None
) -> Fit:
    """Fit field-capacity soil to a half of a record.

    The simulated sums of runoff and means of the level are fitted to the measured values by least
    squares within bounds. Each sum or mean covers an hour, or eight steps (but no more than four
    days) if these are longer, because a simulated step spreads its rain evenly. Beyond ten standard
    deviations of the measurements, the loss grows only linearly ("soft_l1"), so that a broken
    sensor does not dominate. For the comparison, the simulated values are converted to what the
    record's meter would show. The search begins at the best point of a coarse grid, or at another
    fit if this is better.

    Parameters that the record does not identify keep the site's values: any parameter whose column
    of the Jacobian, scaled by the parameter's range, is small or a linear combination of other
    columns (QR with column pivoting; Golub and Van Loan, Matrix Computations, 5.5.7). Intervals
    come from :func:`compute_intervals`, with weeks as groups. Each parameter's interval is widened
    by the largest effect that changing the fixed parameters within their ranges has on this
    parameter.

    Args:
        site: site with field-capacity soil, which provides the start of the search and the values
            of the fixed parameters.
        record: the measurements.
        halves: the steps that are compared (``fit``), and the steps for validation; the roof is
            simulated over all steps.
        start: a fit of a similar site to the same record.
    """
    from scipy.optimize import least_squares  # half a second; not needed for rejected records

    ranges = list_ranges(site, record)
    # The last share is that of the available water capacity that is filled at first.
    own = np.array([*(span.share(getattr(site, span.name)) for span in ranges), 0.5])
    at = np.clip(own, 0.01, 0.99)
    minimum = find_min_reading(record)
    seconds = record.seconds[halves["fit"]]
    span_s = max(HOUR_S, min(_SUM_STEPS * round(record.step_s), _MAX_SUM_S))
    measured = {
        name: combine(name, series[halves["fit"]], seconds, span_s)
        for name, series in record.measured.items()
    }
    weeks = np.tile(np.unique(seconds // span_s) * span_s // _WEEK_S, len(measured))

    def simulated(shares: Values, minimum: float) -> tuple[Site, dict[str, Values]]:
        values = {span.name: span.value(share) for span, share in zip(ranges, shares, strict=False)}
        z_cap = site.a2 * site.z_soil * values["field_capacity"]
        fitted = replace(site, z_cap=z_cap, **values)  # type: ignore[arg-type]
        return fitted, simulate(fitted, record, float(shares[-1]), minimum)

    def differences(shares: Values, minimum: float = minimum) -> Values:
        """Return the residuals, in standard deviations of the measurements."""
        shown = simulated(shares, minimum)[1]
        return np.concatenate([
            (combine(name, shown[name][halves["fit"]], seconds, span_s) - target)
            / (float(np.std(target)) or 1.0) for name, target in measured.items()
        ])

    def cost(shares: Values) -> float:
        """Return the loss that the search minimizes, apart from a constant factor."""
        return float(np.sum(np.sqrt(1 + (differences(shares) / _ROBUST_FROM) ** 2) - 1))

    def jacobian() -> Values:
        """Return the derivatives of the residuals with respect to the shares, shape (n, ranges).

        The minimum reading of the meter is ignored, because it turns a smooth simulation into
        steps. A small difference across a few of these steps would make a parameter look
        identified, or equal columns look different.
        """
        base, columns = differences(at, 0.0), []
        for place, share in enumerate(at):
            moved = at.copy()
            moved[place] += _STEP if share < 0.5 else -_STEP
            columns.append((differences(moved, 0.0) - base) / (moved[place] - share))
        return np.column_stack(columns)

    def solve() -> OptimizeResult:
        def moved(shares: Values) -> Values:
            near = at.copy()
            near[free] = shares
            return differences(near)

        solution = least_squares(
            moved, at[free], bounds=(0.0, 1.0), diff_step=_STEP, loss="soft_l1",
            f_scale=_ROBUST_FROM, xtol=1e-8, ftol=1e-9, max_nfev=60,
        )
        at[free] = solution.x
        return solution

    free = _identify(jacobian())
    starts = [at, *map(np.array, itertools.product(*(
        span.starts if span.starts and is_free else (share,)
        for span, share, is_free in zip(ranges, at, free, strict=False)
    ), at[-1:]))]
    if start is not None:
        found = (span.share(getattr(start.site, span.name)) for span in ranges)
        starts.append(np.array([*found, start.filled]))
    at = min(starts, key=cost)
    solve()
    # Again at the solution: it may identify parameters other than those at the start of the search.
    free = _identify(jacobian())
    at[~free] = own[~free]
    solution = solve()
    # Rows and residuals are scaled for the robust loss as in scipy's least_squares: their product
    # is the gradient, in which a residual has the weight (1 + z)^(-1/2).
    robust = 1 + (solution.fun / _ROBUST_FROM) ** 2
    rows = jacobian() * robust[:, None] ** -0.75
    # How far the fitted parameters follow each held one to the more distant end of its range.
    follows = np.linalg.lstsq(rows[:, free], rows[:, ~free], rcond=None)[0]
    shift = np.linalg.norm(follows * np.maximum(at[~free], 1 - at[~free]), axis=1)
    half = np.full(len(at), np.nan)
    half[free] = np.hypot(
        compute_intervals(rows[:, free], solution.fun * robust**0.25, weeks), shift
    )
    fitted, shown = simulated(at, minimum)
    return Fit(
        fitted, list(map(_judge, ranges, at.tolist(), half.tolist())), float(at[-1]), shown,
        [
            score(name, part, shown[name], record, compared)
            for name in record.measured for part, compared in halves.items()
        ],
    )


def _identify(jacobian: Values) -> Steps:
    """Return a mask of the identified parameters."""
    from scipy.linalg import qr

    _, triangle, order = qr(jacobian, mode="economic", pivoting=True)
    # With fewer residuals than parameters, no more parameters than residuals are identified.
    size = np.zeros(jacobian.shape[1])
    size[order[:len(triangle)]] = np.abs(np.diag(triangle))
    return np.asarray(size > _UNIDENTIFIED * size.max())


def _judge(parameter: FitRange, share: float, half: float) -> FittedParameter:
    """Return a parameter with its interval, or the reason if there is none.

    Args:
        parameter: name and range of the parameter.
        share: value of the parameter, as a share of the range.
        half: half-width of the interval, as a share of the range; NaN if the data do not determine
            the parameter.
    """
    value, low, high = map(parameter.value, (share, *np.clip((share - half, share + half), 0, 1)))
    why = ""
    if math.isnan(half):
        why = "the record does not determine it"
    elif not 0.005 < share < 0.995:
        why = f"at the limit of its range ({parameter.low:.3g} to {parameter.high:.3g})"
    return FittedParameter(parameter.name, value, low, high, why)


def compute_intervals(jacobian: Values, residuals: Values, groups: NDArray[np.int64]) -> Values:
    """Return the half-width of every parameter's 95 % interval.

    The method is Tukey's jackknife (Efron 1982, doi:10.1137/1.9781611970319) with Student's t. The
    fit is treated as linear: leaving out a group with residuals r_g and Jacobian J_g moves the
    parameters by (J'J - J_g'J_g)^-1 J_g' r_g. If few groups contain most of the information about a
    parameter, its variance is less certain. The degrees of freedom are Kish's effective number of
    groups minus one, sum(w)^2 / sum(w^2) - 1, where w is the information that is lost without a
    group; they are at least 1. If all groups are equal, the degrees of freedom are the number of
    groups minus one. If one group alone determines nearly everything about a parameter, nothing
    shows how the parameter would vary, and the half-width of its interval is infinite.

    A parameter's information is the sum of squares of its column that is not explained by the other
    columns, which is 1 over the parameter's diagonal of (J'J)^-1.

    Args:
        jacobian: Jacobian at the fit, shape (n, parameters).
        residuals: residuals at the fit, shape (n,).
        groups: index of the group to which each residual belongs, shape (n,). Residuals in one
            group may depend on each other.
    """
    from scipy.stats import t as student  # half of the import time; not for rejected records

    # What is left without a group can be singular.
    tiny = 1e-12 * np.trace(jacobian.T @ jacobian) * np.eye(jacobian.shape[1])

    def invert(rows: Values) -> Values:
        return np.asarray(np.linalg.inv(rows.T @ rows + tiny))

    members = [groups == group for group in np.unique(groups)]
    left = [invert(jacobian[~own]) for own in members]
    moved = [
        inv @ (jacobian[own].T @ residuals[own]) for inv, own in zip(left, members, strict=True)
    ]
    whole = 1 / np.diag(invert(jacobian))
    lost = whole - [1 / np.diag(inverse) for inverse in left]
    degrees = np.maximum(1.0, lost.sum(axis=0) ** 2 / np.sum(lost**2, axis=0) - 1)
    variance = np.var(moved, axis=0) * (len(moved) - 1)
    half = student.ppf(0.975, degrees) * np.sqrt(variance)
    return np.where(lost.max(axis=0) >= _ALONE * whole, np.inf, half)


def fit_exponents(
    site: Site, record: StepRecord, halves: Mapping[str, Steps],
    update_progress: UpdateProgress = lambda text, share: None,
    exponents: Sequence[float] = EXPONENTS,
) -> list[Fit]:
    """Fit a roof with each exponent of percolation, in ascending order.

    The exponent changes the shape of the soil's response, for which the other parameters can make
    up in the half that they are fitted to. Therefore exponents are compared in the other half.

    Args:
        site: as for :func:`fit`.
        record: the measurements.
        halves: the steps that are fitted, and the steps for validation.
        update_progress: callback that receives the progress before every fit.
        exponents: exponents to compare.
    """
    fits: list[Fit] = []
    for number, exponent in enumerate(exponents):
        update_progress(f"fitting with exponent {exponent:g}", number / len(exponents))
        fits.append(fit(replace(site, percolation_exponent=exponent), record, halves, *fits[-1:]))
    return fits


def choose_exponent(fits: Sequence[Fit], own: float) -> tuple[Fit, str]:
    """Return the fit to use, with the exponent among its parameters, and a note on the others.

    The validation cannot distinguish exponents whose NSE is within 0.05 of the best, because it
    depends on a few storms. If the site's own exponent is among them, it is kept; otherwise, the
    best exponent is used. Between the exponents that were compared, the NSE is interpolated.

    Args:
        fits: fits with each exponent, including the site's own, in ascending order.
        own: exponent of the site.
    """
    exponents = np.array([each.site.percolation_exponent for each in fits])
    nses = np.array([each.nse for each in fits])
    limit = nses.max() - ALIKE
    alike = np.flatnonzero(nses >= limit)
    kept = [place for place in alike if exponents[place] == own]
    chosen = fits[int([*kept, nses.argmax()][0])]
    outside = np.clip([alike[0] - 1, alike[-1] + 1], 0, len(fits) - 1)
    low, high = (
        float(np.interp(limit, nses[places], exponents[places]))
        for places in np.stack((outside, alike[[0, -1]]), axis=1)
    )
    parameter = FittedParameter(
        "percolation_exponent", chosen.site.percolation_exponent, low, high,
        "not a 95 % interval: the validation does not tell these exponents apart",
    )
    tried = zip(nses, exponents, strict=True)
    of_each = ", ".join(f"{nse:.2f} with {exponent:g}" for nse, exponent in tried)
    return (
        chosen._replace(parameters=[*chosen.parameters, parameter]),
        f"percolation_exponent: the NSE in the validation is {of_each}; exponents within "
        f"{ALIKE:g} of the best are not told apart",
    )
