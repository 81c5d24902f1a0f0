"""The pumps of a site, from how fast their cistern falls while they run."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from greenroof_ros.calibration.fit import Parameter
from greenroof_ros.calibration.intervals import half_intervals, moves
from greenroof_ros.calibration.record import Record, Values
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.model.plant import maximum_pump_flow
from greenroof_ros.model.site import Site
from greenroof_ros.weather.records import gaps

# So long after rain a catchment still runs (s), and so far from the levels of outlet, valve and
# suction a sensor's noise does not matter (m).
_WET_S = 3600
_APART_M = 0.05
_FEWEST_RUNS = 10
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


class _Runs(NamedTuple):
    """The levels from the beginning to the end of each run, one run after the other."""

    level: Values
    """m, shape (n,)"""
    between: Values
    """mean of each and the next (m); at the end of a run that level itself"""
    command: Values
    """from each level to the next; at the end of a run 0"""
    number: NDArray[np.int64]
    """of the run that each is of, from 0"""


def fit_pump(site: Site, record: Record) -> PumpFit | None:
    """Fit the pump curve to the fall of the cistern while the pumps run and nothing flows in.

    At command 1 and a level z they lift, by Eqs. (3b)-(3e),

        q(z) = Q sqrt(1 + (z - Z) / H),  H = Z + c_hat - d,  Q^2 = H / (pipe_resistance - a_hat),

    with Z the mean level: Q is how much they lift, and H what a level changes in it. At a command
    they lift that share. The levels of each run, but for their mean, are brought near to what that
    leaves in the cistern, by least squares; so a sensor's offset does not count, and its noise is
    that of all levels of a run. Intervals are those of :mod:`greenroof_ros.calibration.intervals`,
    with runs as groups.

    Where levels change the head by too little to tell H, ``a_hat`` stays as it is, and ``c_hat``
    follows from Q alone.

    Args:
        site: its cistern and pipe, and the curve that is held where the data do not tell it.
        record: what was measured.

    Returns:
        None where the record has no command or no level of the cistern, or fewer than ten runs
        without rain, between the outlet and the lowest level at which pumps and mains leave it.

    Raises:
        ConfigurationError: the cistern falls by nothing like what the pumps can lift.
    """
    if record.command is None or record.cistern is None:
        return None
    found = gaps(_running(site, record, record.command, record.cistern))
    if len(found) < _FEWEST_RUNS:
        return None
    runs = _levels(found, record.command, record.cistern)
    middle = float(np.average(runs.between, weights=runs.command))
    most = maximum_pump_flow(site, middle * site.a1)
    head = middle + site.c_hat - site.d

    def residuals(shares: Values) -> Values:
        """Take the flow as a share of the site's, and 1 / H as one, or as ``a_hat`` makes it."""
        slope = (shares[1] if len(shares) > 1 else shares[0] ** -2) / head
        flows = np.sqrt(np.maximum(1 + slope * (runs.between - middle), 0.0)) * most * shares[0]
        taken = flows * runs.command * record.step_s / site.a1
        kept = runs.level + np.cumsum(taken) - taken
        means = np.bincount(runs.number, kept) / np.bincount(runs.number)
        return np.asarray(kept - means[runs.number])

    def derived(shares: Values) -> Values:
        """Return flow, a_hat and c_hat, shape (..., 3)."""
        flow = most * shares[..., 0]
        lifted = head / shares[..., 1] if shares.shape[-1] > 1 else head * shares[..., 0] ** 2
        return np.stack(
            [flow, site.pipe_resistance - lifted / flow**2, lifted + site.d - middle], axis=-1
        )

    def solve(parameters: int) -> tuple[Values, Values]:
        """Return the shares, and what each run would make of them by its absence."""
        found: OptimizeResult = least_squares(residuals, np.ones(parameters), bounds=(1e-3, 1e3))
        return found.x, found.x + moves(found.jac, found.fun, runs.number)

    shares, others = solve(2)
    if not 1 / _BELIEVABLE < shares[0] < _BELIEVABLE:
        raise ConfigurationError(
            f"falls while the pumps run as if they lifted {1000 * most * shares[0]:.2g} l/s at "
            f"full command, and by the site's curve they lift {1000 * most:.2g} l/s; is the sensor "
            "stuck, a unit wrong, or the pump state that of other pumps?", file=record.source,
            key="cistern level",
        )
    shape_told = derived(shares)[1] < 0 and half_intervals(others)[1] < _HARDLY * shares[1]
    if not shape_told:
        shares, others = solve(1)
    flow, a_hat, c_hat = derived(shares).tolist()
    half = half_intervals(derived(others)).tolist()
    shape = Parameter("a_hat", a_hat, a_hat - half[1], a_hat + half[1], "")
    if not shape_told:
        shape = Parameter(
            "a_hat", site.a_hat, np.nan, np.nan, "the data cannot tell it apart from c_hat"
        )
    height = Parameter("c_hat", c_hat, c_hat - half[2], c_hat + half[2], "")
    fitted = replace(site, a_hat=shape.value, c_hat=c_hat)
    return PumpFit(fitted, [shape, height], flow, half[0], middle, len(found))


def _running(
    site: Site, record: Record, command: Values, level: Values
) -> NDArray[np.bool_]:
    """Return in which steps the pumps run and nothing else moves the cistern."""
    wet = ~(record.rain == 0)
    recent = np.convolve(wet, np.ones(round(_WET_S / record.step_s) + 1), "full")[:record.steps] > 0
    low = max(site.suction_level, site.mains_level or 0.0) + _APART_M
    between = (level > low) & (level < site.lowest_outlet - _APART_M)
    return np.asarray((command > 0) & ~recent & between & np.append(between[1:], False))


def _levels(found: list[tuple[int, int]], command: Values, level: Values) -> _Runs:
    """Return the levels of runs, given as first step and one past the last."""
    levels = [level[first:end + 1] for first, end in found]
    return _Runs(
        np.concatenate(levels),
        np.concatenate([np.append((one[:-1] + one[1:]) / 2, one[-1]) for one in levels]),
        np.concatenate([np.append(command[first:end], 0.0) for first, end in found]),
        np.repeat(np.arange(len(found)), [len(one) for one in levels]),
    )
