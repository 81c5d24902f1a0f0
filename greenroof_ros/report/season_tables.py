"""The tables of the same season in several years, and of cisterns of several sizes."""

from __future__ import annotations

from collections.abc import Sequence

from greenroof_ros.recording.results_table import differing
from greenroof_ros.report.cells import NONE, Cell, Table, number, share, word
from greenroof_ros.report.results import Report, heading
from greenroof_ros.report.seasons import (
    Comparison,
    Interval,
    Seasons,
    comparisons,
    least_deviation,
    plain_onoff,
    seasons,
)
from greenroof_ros.report.settings import controller_name
from greenroof_ros.report.sizing import is_sizing, size_of

# Means of a season: header, metric and format.
_MEANS = (
    ("mean deviation (mm)", "mean_deviation_mm", ".2f"),
    ("water stress (h)", "stress_hours", ".1f"),
    ("evapotranspiration ratio", "evapotranspiration_ratio", ".1%"),
    ("rain kept", "rain_kept_share", ".1%"),
    ("rain kept above 20 mm/h", "rain_kept_share_hour", ".1%"),
    ("rain kept above 10 mm in 24 h", "rain_kept_share_day", ".1%"),
    ("mains water saved (m³)", "saved_m3", ".2f"),
    ("mains water used (m³)", "mains_m3", ".2f"),
    ("pumped (m³)", "pumped_m3", ".2f"),
    ("overflow (m³)", "outflow_m3", ".2f"),
    ("drainage (m³)", "drainage_m3", ".2f"),
    ("electric energy (kWh)", "electric_energy_kwh", ".3g"),
    ("pump starts (1)", "pump_starts", ".0f"),
)


def season_windows(report: Report) -> list[str]:
    """Name the seasons, each with its years."""
    found = seasons(report)
    apart = differing([one.place.facts for one in found])
    years: dict[str, set[int]] = {}
    for one in found:
        facts = one.place.facts
        years.setdefault(heading(facts, [*apart, "begins", "length"]), set()).update(one.years)
    return [f"{name}, {_span(sorted(found))}" for name, found in years.items()]


def _span(years: Sequence[int]) -> str:
    whole = years[-1] - years[0] + 1 == len(years)
    return f"{years[0]} to {years[-1]}" if whole else ", ".join(map(str, years))


def season_tables(report: Report) -> list[Table]:
    """Return means and comparisons, or of several cisterns or roofs sizes; none without seasons."""
    found = seasons(report)
    if not found:
        return []
    where = differing([one.place.facts for one in found])
    tables = [_means(found, where)]
    if is_sizing(found):
        return tables
    plain, least = plain_onoff(found), least_deviation(found)
    others = {place: one for place, one in least.items() if one is not plain.get(place)}
    for other, references in (
        ("on/off", plain), ("the controller with the least deviation", others)
    ):
        compared = list(comparisons(found, references))
        if compared:
            tables.append(_comparisons(other, compared, where))
    return tables


def _comparisons(other: str, compared: Sequence[Comparison], where: Sequence[str]) -> Table:
    """Return what each has over another."""
    return Table(
        f"Deviation over that of {other}, and how sure that is",
        [
            *_named_header(where), "over", "years with less deviation", "more or less (m³)",
            "verdict", "deviation of a season, over (1)", "95 % from", "to",
            "verdict of worst weeks", "worst tenth of weeks, over (1)", "95 % from", "to",
        ],
        [
            [
                *_named(one.of, where),
                word(" ".join(cell.text for cell in _named(one.than, []))),
                Cell(f"{one.better} of {one.years}", one.better),
                number(one.difference, "+.0f"),
                word(one.mean.verdict), *_interval(one.mean),
                word(one.worst_weeks.verdict), *_interval(one.worst_weeks),
            ]
            for one in compared
        ],
    )


def _named_header(where: Sequence[str]) -> list[str]:
    return ["controller", "setting", "forecast", *where]


def _named(one: Seasons, where: Sequence[str]) -> list[Cell]:
    return [
        word(controller_name(one.controller)), word(one.setting), word(one.forecast),
        *(word(one.place.facts[name]) for name in where),
    ]


def _means(found: Sequence[Seasons], where: Sequence[str]) -> Table:
    """Return the table of means; of sites of several sizes with their sizes."""
    sized = is_sizing(found)
    known = any(one.ratio_to_bound is not None for one in found)
    means = [
        each for each in _MEANS
        if any(each[1] in run.metrics for one in found for runs in one.years.values()
               for run in runs)
    ]

    def row(one: Seasons) -> list[Cell]:
        size = size_of(one.site)
        totals = one.of_years("total_deviation_m3")
        return [
            *_named(one, where),
            *([number(size.roof_m2, "g"), number(size.cistern_m3, "g")] if sized else []),
            number(len(one.years), "d"),
            number(one.seeds, "d"),
            number(one.mean("total_deviation_m3"), ".0f"),
            *([share(one.ratio_to_bound)] if known else []),
            number(totals[one.worst_year], ".0f"),
            number(one.worst_year, "d"),
            number(one.worst_weeks, ".0f"),
            number(100 * one.mean("near_target_hours") / one.place.hours, ".1f"),
            *(
                number(one.mean(metric), form) if one.of_years(metric) else NONE
                for _, metric, form in means
            ),
        ]

    return Table(
        "Means of a season",
        [
            *_named_header(where),
            *(["green roof (m²)", "cistern (m³)"] if sized else []),
            "years", "seeds", "total deviation (m³)",
            *(["over the least possible (1)"] if known else []),
            "worst year (m³)", "which", "worst tenth of weeks, of a week (m³)", "near target (%)",
            *(header for header, _, _ in means),
        ],
        [row(one) for one in found],
    )


def _interval(interval: Interval) -> list[Cell]:
    return [number(value, ".3f") for value in interval]
