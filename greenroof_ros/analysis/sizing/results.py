"""The results of a sizing that are printed and drawn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from greenroof_ros.analysis.sizing.choice import Values
from greenroof_ros.analysis.tables import COLUMNS, Column, format_number, format_share

PAGE, TABLE = "sizes.html", "sizes.csv"

KEPT, LOST, COST = "storm_water_kept_share", "evapotranspiration_lost_share", "cost"
"""Results besides the metrics: the share of the rain on roof and catchment that does not reach the
sewer in wet weather; the share of the potential evapotranspiration that is lost for lack of water;
and the cost of a season's water, with a year's share of the cistern."""

SHOWN = {
    "demand_met_share": COLUMNS["demand_met_share"],
    "mains_m3": COLUMNS["mains_m3"],
    KEPT: Column("rain kept out of the sewer in wet weather", "%", format_share),
    "wet_discharge_m3": COLUMNS["wet_discharge_m3"],
    "discharge_m3": COLUMNS["discharge_m3"],
    "retention_share": COLUMNS["retention_share"],
    "overflow_days": COLUMNS["overflow_days"],
    LOST: Column("lost evapotranspiration", "%", format_share),
    "stress_hours": COLUMNS["stress_hours"],
    COST: Column("cost of a season", "in the currency of the prices", format_number),
}
"""the results that are printed and drawn, by name"""


Results = dict[str, Values]
"""results of a design by name, with a value for each season, shape (seasons,)"""


class Spread(NamedTuple):
    """The mean, the lowest and the highest value of a result over the seasons."""

    mean: float
    low: float
    high: float


def find_spread(values: Values) -> Spread:
    """Return the mean, the lowest and the highest of the known values."""
    known = values[~np.isnan(values)]
    if not known.size:
        return Spread(np.nan, np.nan, np.nan)
    return Spread(float(known.mean()), float(known.min()), float(known.max()))
