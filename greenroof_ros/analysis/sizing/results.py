"""The results of a sizing, and their presentation."""

from __future__ import annotations

from greenroof_ros.analysis.tables import COLUMNS, Column, format_share

PAGE, TABLE = "sizes.html", "sizes.csv"
BY_TEST = ["assumption", "value", "best_cistern_m3"]
"""columns that identify what is assumed, and the cistern that would be recommended then"""

KEPT, LOST = "storm_water_kept_share", "evapotranspiration_lost_share"
"""Results besides the metrics: the share of the rain on roof and catchment that does not reach the
sewer in wet weather; and the share of the potential evapotranspiration that is lost for lack of
water."""

SHOWN = COLUMNS | {
    KEPT: Column("rain kept out of the sewer in wet weather", "%", format_share),
    LOST: Column("lost evapotranspiration", "%", format_share),
}
"""the presentation of each result, by name"""
MAIN = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", "retention_share")
"""the results in tables of cisterns"""
