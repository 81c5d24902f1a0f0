"""The results of a sizing that are printed and drawn."""

from __future__ import annotations

from greenroof_ros.analysis.tables import COLUMNS, Column, format_number, format_share

PAGE, TABLE = "sizes.html", "sizes.csv"
BY_DESIGN = ["volume_m3", "target_mm", "outlet"]
"""columns that identify a design"""

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
MAIN = ("mains_m3", "wet_discharge_m3", KEPT, "discharge_m3", "retention_share")
"""those of the main table"""
