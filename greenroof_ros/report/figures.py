"""The figures of the paper and some beyond it; one specification makes page, PNG and SVG."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from greenroof_ros.report.balance_figure import balance
from greenroof_ros.report.drawing import Figure
from greenroof_ros.report.pump_figures import pump_curve, pump_smoothing, read_pump_data
from greenroof_ros.report.results import Report
from greenroof_ros.report.season_figures import SEASON_FIGURES, season_figures
from greenroof_ros.report.seed_figures import forecast_errors
from greenroof_ros.report.setting_figures import QUANTITIES, by_setting
from greenroof_ros.report.trajectory_figures import trajectories
from greenroof_ros.report.weather_figure import weather

# The names of all figures begin with these; their numbers follow.
_KINDS = (
    "pump-curve", "pump-smoothing", "weather", *(one.name for one in QUANTITIES), "trajectories",
    "water-balance", "forecast-errors", *SEASON_FIGURES,
)


def is_figure(name: str) -> bool:
    """Whether a file's name is that of a report's figure."""
    return re.fullmatch(rf"({'|'.join(_KINDS)})(-\d+)*\.(svg|png)", name) is not None


def make_figures(report: Report, pump_data: Path | None) -> list[Callable[[], Figure]]:
    """Return what makes each figure, so that a caller can show how far it is.

    Args:
        report: all results.
        pump_data: points of the pumps' data sheet, if there are any.

    Raises:
        ConfigurationError: their file is wrong.
    """
    points = read_pump_data(pump_data) if pump_data is not None else None
    # Seasons are of many sites, which differ in size alone: their pumps are the same.
    alone = [*(one.entry for one in report.results), *report.seeded]
    sites = {entry.site_name: entry.site for entry in alone}
    makers: list[Callable[[], Figure]] = []
    # Windows that differ in the evapotranspiration only share a figure of the weather.
    skies = dict.fromkeys(window.sky for window in report.windows)
    for number, sky in enumerate(skies, start=1):
        makers.append(partial(weather, report, sky, number))
    for number, window in enumerate(report.windows, start=1):
        # A single mark in each panel would say what the table does.
        if any(len(report.of(window, name)) > 1 for name in report.controllers):
            for quantity in QUANTITIES:
                makers.append(partial(by_setting, report, window, number, quantity))
    for number, window in enumerate(report.windows, start=1):
        for initial in report.initials:
            if report.of(window, initial=initial):
                makers.append(partial(trajectories, report, window, number, initial))
    for number, window in enumerate(report.windows, start=1):
        makers.append(partial(balance, report, window, number))
    if report.seeded:
        makers.append(partial(forecast_errors, report))
    if report.seasons:
        makers += season_figures(report)
    for number, (name, site) in enumerate(sites.items(), start=1):
        of = f" of {name}" if len(sites) > 1 else ""
        makers.append(partial(pump_curve, site, number, of, points))
        makers.append(partial(pump_smoothing, site, number, of))
    return makers
