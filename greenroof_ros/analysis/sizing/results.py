"""The results of a sizing, and their presentation."""

from __future__ import annotations

from greenroof_ros.analysis.tables import COLUMNS, Column, format_number, format_share

PAGE, TABLE = "sizes.html", "sizes.csv"

KEPT, LOST, COST = "storm_water_kept_share", "evapotranspiration_lost_share", "cost"
"""Results besides the metrics: the share of the rain on roof and catchment that does not reach the
sewer in wet weather; the share of the potential evapotranspiration that is lost for lack of water;
and the cost of a season's water, with a year's share of the cistern."""

SHOWN = COLUMNS | {
    KEPT: Column("rain kept out of the sewer in wet weather", "%", format_share),
    LOST: Column("lost evapotranspiration", "%", format_share),
    COST: Column("cost of a season", "in the currency of the prices", format_number),
}
"""the presentation of each result, by name"""
MAIN = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", "retention_share", COST)
"""the results in every table; there is no cost without prices"""
OF_PLANTS = (*MAIN, LOST, "stress_hours")
"""those in tables of what plants lose"""
