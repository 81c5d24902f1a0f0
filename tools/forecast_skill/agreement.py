"""How similar forecasts of the same hours are, and how much better their mean is than one of them.

A poor man's ensemble has one forecast from each of several services (Ebert 2001, Monthly Weather
Review 129, 2461-2480). The gain of its mean depends on how similar its members are. So the gain
shows whether members of the package's ensembles are more independent than services are.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
import polars as pl
from forecast_skill.figures import table


class Agreement(NamedTuple):
    """How well forecasts of the same sums agree with the records, and with each other.

    Attributes:
        alone: r of each with the records, shape (members,).
        pairs: r of each pair, in the order of ``itertools.combinations``.
        mean: r of their mean with the records.
    """

    alone: np.ndarray
    pairs: np.ndarray
    mean: float

    @property
    def gain(self) -> float:
        """r of the mean over the mean r of single members (1)."""
        return self.mean / float(self.alone.mean())


def agreement(alone: np.ndarray, covariance: np.ndarray) -> Agreement:
    """Return the agreement of forecasts from their r and covariance, without the series.

    The covariance of a mean with the records is the mean of its members' covariances with them, so
    r of the mean is sum(r_i s_i) / sqrt(sum(C_ij)), with standard deviations s and covariances C.

    Args:
        alone: r of each with the records, shape (members,).
        covariance: of the forecasts (mm2), shape (members, members).
    """
    deviations = np.sqrt(np.diag(covariance))
    likeness = covariance / np.outer(deviations, deviations)
    return Agreement(
        alone, likeness[np.triu_indices(len(alone), 1)],
        float(alone @ deviations / math.sqrt(covariance.sum())),
    )


def of_services(day: int, hours: int) -> Agreement:
    """Return the agreement of GEM, GFS and KNMI on a day ahead; on the fifth without GFS.

    Their r is over the hours that the gauge has, their covariances are over all hours. For sums
    over 72 and 120 h only covariances are known, so values that need r are NaN.
    """
    pairs = table("services_covariance.csv").filter(day=day, sum_hours=hours)
    both_ways = pl.concat([pairs, pairs.rename({"model": "other_model", "other_model": "model"})
                           .select(pairs.columns)]).unique()
    square = both_ways.sort("model", "other_model")["covariance"].to_numpy()
    names = both_ways["model"].unique().sort().to_list()
    alone = dict(
        table("skill.csv").filter(days_ahead=day, sum_hours=hours).select("model", "r").iter_rows()
    )
    return agreement(
        np.array([alone.get(name, math.nan) for name in names]),
        square.reshape(len(names), len(names)),
    )


def of_members(forecasts: np.ndarray, observed: np.ndarray, hours: int, count: int) -> Agreement:
    """Return the agreement of ensembles of ``count`` members, the mean over all choices of members.

    Args:
        forecasts: of each hour (mm), shape (members, hours); NaN if there is none. Hours at the end
            that do not fill a sum are left out.
        observed: the records of these hours (mm).
        hours: length of a sum.
        count: number of members of an ensemble.
    """
    whole = len(observed) // hours * hours
    sums = forecasts[:, :whole].reshape(len(forecasts), -1, hours).sum(axis=2)
    seen = observed[:whole].reshape(-1, hours).sum(axis=1)
    given = ~np.isnan(sums).any(axis=0)
    sums, seen = sums[:, given], seen[given]
    alone = np.array([np.corrcoef(member, seen)[0, 1] for member in sums])
    means = [
        np.corrcoef(sums[list(some)].mean(axis=0), seen)[0, 1]
        for some in combinations(range(len(sums)), count)
    ]
    pairs = np.corrcoef(sums)[np.triu_indices(len(sums), 1)]
    return Agreement(alone, pairs, float(np.mean(means)))
