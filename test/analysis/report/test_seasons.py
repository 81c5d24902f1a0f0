"""The same season in several years: means and ratios by hand, intervals by another library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from inputs import figures_of, report_of, study_of
from studies import record, run_here

from greenroof_ros.analysis.report.figures import make_figures
from greenroof_ros.analysis.report.groups import TOTAL, CaseRuns, Report
from greenroof_ros.analysis.report.intervals import Array, SeasonComparison, compare
from greenroof_ros.analysis.report.tables import make_notes, make_tables

YEARS = range(2015, 2026)
ONOFF = {year: 100.0 + 10 * (year - 2015) for year in YEARS}


def rows(controller: str, seed: int | None, totals: dict[int, float]) -> list[dict[str, Any]]:
    """Return runs of 16 days."""
    forecast: dict[str, Any] = {"forecast": "perfect"}
    if seed is not None:
        forecast = {"forecast": "errors", "forecast_skill": "real", "forecast_seed": seed}
    return [
        {
            "site": "site.yaml", "weather": f"{year}.csv", "start": f"{year}-05-01T00:00:00-05:00",
            "hours": 384.0, "evapotranspiration": "fao56", **forecast, "controller": controller,
            "initial": "low-low", "cistern_m3": 57.7, "roof_m3": 2.4, "status": "done",
            TOTAL: total, "near_target_hours": 96.0, "mains_m3": 2.0 + (seed or 0),
            "outflow_m3": 1.0, "bound_m3": 50.0,
            "window": "May", "season": "from 01 May",
            "case": f"{controller} {forecast['forecast']}",
        }
        for year, total in totals.items()
    ]


def deviations(*seeds: dict[int, float]) -> dict[int, Array]:
    """Return deviations with one seed for each of these totals."""
    return {year: np.array([of_seed[year] for of_seed in seeds]) for year in seeds[0]}


def relative_to_onoff(*seeds: dict[int, float]) -> SeasonComparison:
    """Return the comparison with on/off of a controller with one seed for each of these totals."""
    comparison = compare(deviations(*seeds), deviations(ONOFF))
    assert comparison is not None
    return comparison


# --- statistics ----------------------------------------------------------------------------------


def test_ratios_and_what_is_reported_of_them() -> None:
    """Equal in all years is certain; changing signs contain 1."""
    comparison = relative_to_onoff({year: total * 0.8 for year, total in ONOFF.items()})
    assert comparison.mean == pytest.approx((0.8, 0.8, 0.8))
    assert (comparison.better, comparison.years) == (11, 11)
    assert comparison.difference == pytest.approx(-30)
    comparison = relative_to_onoff({year: total + 30 for year, total in ONOFF.items()})
    assert comparison.better == 0
    assert (comparison.mean.value, comparison.difference) == pytest.approx((180 / 150, 30))
    alternating = {year: total + (-1) ** year * 30 for year, total in ONOFF.items()}
    comparison = relative_to_onoff(alternating)
    assert comparison.mean.low < 1 < comparison.mean.high
    assert comparison.better == 6  # the odd years
    # No interval of two years is narrow, but no deviation is below 0.
    two = {2015: 1.0, 2016: 200.0}
    comparison = compare(deviations(two), deviations(dict.fromkeys(two, 100.0)))
    assert comparison is not None and comparison.mean.low == 0.0
    # If on/off never leaves its target, or in all years of a resample, or for a single year, there
    # is no ratio.
    assert compare(deviations(ONOFF), deviations(dict.fromkeys(YEARS, 0.0))) is None
    assert compare(deviations(ONOFF), deviations({2015: 0.0, 2016: 5.0, 2017: 4.0})) is None
    assert compare(deviations({2015: 1.0}), deviations(ONOFF)) is None
    # Seeds with the same mean in every year leave no uncertainty, however different they are.
    apart = [{year: total + more for year, total in ONOFF.items()} for more in (-40, 40)]
    assert relative_to_onoff(*apart).mean == pytest.approx((1, 1, 1))


# Student's interval of a mean of eleven over the bootstrap's; t and z from tables.
WIDER = 2.22814 / 1.95996 * np.sqrt(11 / 10)


def test_intervals_of_another_library() -> None:
    """Scipy's percentile bootstrap of the years, widened."""
    random = np.random.default_rng(7)
    own = {year: total + random.normal(-10, 20) for year, total in ONOFF.items()}
    comparison = relative_to_onoff(own)

    def mean(years: Any) -> float:
        return float(np.divide(*(sum(run[2015 + year] for year in years) for run in (own, ONOFF))))

    resampled = scipy.stats.bootstrap(
        (range(11),), mean, method="percentile", vectorized=False, n_resamples=10_000,
        random_state=1,
    ).bootstrap_distribution
    interval = comparison.mean
    assert interval.value == pytest.approx(mean(range(11)))
    for end, level in ((interval.low, 2.5), (interval.high, 97.5)):
        # With 2000 resamples a percentile is accurate to 0.35.
        near = np.percentile(resampled, [level - 1, level + 1])
        low, high = interval.value + WIDER * (near - interval.value)
        assert low - 1e-5 <= end <= high + 1e-5


# --- a study's cases -----------------------------------------------------------------------------


def case_of(report: Report, controller: str) -> CaseRuns:
    """Return the only case of a controller."""
    (case,) = (case for case in report.cases if case.row["controller"] == controller)
    return case


def test_means_by_hand(tmp_path: Path) -> None:
    """Over years, in each over its seeds; the worst year."""
    lower = {year: total - 20 for year, total in ONOFF.items()}
    onoff = rows("onoff", None, ONOFF)
    onoff[0]["roof_retention_share"], onoff[1]["roof_retention_share"] = 0.5, 0.75
    report = study_of(
        tmp_path / "study", *onoff, *rows("mpc", 1, ONOFF), *rows("mpc", 2, lower)
    )
    case = case_of(report, "mpc")
    assert case.row[TOTAL] == pytest.approx(150 - 10)
    assert case.row["mains_m3"] == pytest.approx(3.5)
    assert case.row["mains_below_onoff_m3"] == pytest.approx(2.0 - 3.5)
    assert "mains_below_onoff_m3" not in case_of(report, "onoff").row  # it is the reference
    assert case.row["ratio"] == pytest.approx(140 / 50)
    tables = make_tables(report)
    spread = tables["Over seeds and years"][1]
    assert (spread["runs"], spread["years"]) == ("22", "11")
    assert spread["worst year"] == "2025: 190.00 m³"
    (compared,) = tables["Deviation relative to on/off"]
    assert compared["years with a smaller deviation"] == "11 of 11"
    # The mean is over years with a share; without one there is no number.
    shares = [row["retention of the roof"] for row in tables["Plants, rain and frost"]]
    assert shares == ["62.5%", "none"]
    assert not make_notes(report)


def test_reference_is_plain_onoff(tmp_path: Path) -> None:
    """On/off to a lower level is compared with on/off to the target, by the best setting.

    A setting that lacks its worst years is not the best.
    """
    lower, full, tenth = (
        [{**row, "parameter:fraction": fraction, "parameter:level": level,
          "case": f"onoff {fraction} {level}"}
         for row in rows("onoff", None, {year: total + more for year, total in ONOFF.items()})]
        for fraction, level, more in ((0.1, 0.9, -30), (1.0, 1.0, 15), (0.1, 1.0, 0))
    )
    report = study_of(tmp_path / "a", *lower, *full, *tenth, *rows("mpc", None, ONOFF))
    assert {
        case.label: case.relative.mean.value
        for case in report.cases if case.relative is not None
    } == pytest.approx({"onoff 0.1 0.9": 0.8, "onoff 1.0 1.0": 1.1, "mpc perfect": 1})
    report = study_of(tmp_path / "b", *lower, *rows("mpc", None, ONOFF))
    assert all(case.relative is None for case in report.cases)
    five = [
        {**row, "status": "failed", "error": "no solution", TOTAL: ""}
        if row["weather"] > "2020" else row for row in tenth
    ]
    report = study_of(tmp_path / "c", *full, *five, *rows("mpc", None, ONOFF))
    mpc = case_of(report, "mpc").relative
    assert mpc is not None and mpc.years == 11 and mpc.mean.value == pytest.approx(150 / 165)
    assert make_tables(report)["Over seeds and years"][1]["runs"] == "5, 6 failed ⚠"
    (few,) = make_notes(report).values()
    assert few == ["onoff 0.1 1.0: 5"]


def test_storm_water_is_compared_with_a_closed_valve(tmp_path: Path) -> None:
    """Although on/off that drains has less deviation: 30 and 10 m3 in wet weather, 5 less mains."""
    closed, drain, mpc = (
        [
            {**row, "parameter:outlet": outlet, "wet_discharge_m3": wet, "mains_m3": mains,
             "case": f"{controller} {outlet}"}
            for row in rows(controller, None, {year: total + more for year, total in ONOFF.items()})
        ]
        for controller, outlet, more, wet, mains in (
            ("onoff", "closed", 15, 30.0, 2.0), ("onoff", "drain", 0, 10.0, 7.0),
            ("mpc", "drain", 0, 12.0, 4.0),
        )
    )
    below = "wet_discharge_below_onoff_m3", "mains_below_onoff_m3"
    report = study_of(tmp_path / "a", *closed, *drain, *mpc)
    assert {
        case.label: tuple(case.row.get(name) for name in below) for case in report.cases
    } == {"onoff closed": (None, None), "onoff drain": (20.0, -5.0), "mpc drain": (18.0, -2.0)}
    assert [
        row["wet-weather discharge avoided compared with on/off (m³)"]
        for row in make_tables(report)["Storm water"]
    ] == ["none", "20", "18"]
    report = study_of(tmp_path / "b", *drain, *mpc)
    assert case_of(report, "mpc").row["wet_discharge_below_onoff_m3"] == -2.0


def test_mains_water_is_not_shown_of_a_site_without_mains(tmp_path: Path) -> None:
    """Neither in a table nor in a figure, although its valve lets storm water out."""
    runs = [
        {**row, "parameter:outlet": "drain", "wet_discharge_m3": 10.0, "mains_m3": mains}
        for mains in (2.0, None) for controller in ("onoff", "mpc")
        for row in rows(controller, None, ONOFF)
    ]
    (topped_up, with_mains), (not_topped_up, without) = (
        (make_tables(report), {figure.name for figure in make_figures(report)})
        for report in (study_of(tmp_path / "a", *runs[:22]), study_of(tmp_path / "b", *runs[22:]))
    )
    assert "mains" in str(topped_up) and "mains" not in str(not_topped_up)
    assert with_mains - without == {"discharge-1"}


# --- from the grid to the figures ----------------------------------------------------------------

SEASONS_GRID = """
site: {file: site.yaml, tau: 600.0}
weather:
  - {file: "{year}_*.csv", start: "{year}-05-01T00:00", year: {from: 2015, to: 2016}, hours: 192,
     evapotranspiration: fao56}
bound_block: 0
forecast: {model: errors, skill: real, seed: {from: 1, to: 2}}
initial: low-low
controllers:
  onoff: {forecast: perfect}
  mpc: {weight: 0.01}
"""


def test_a_study_of_seasons(tmp_path: Path) -> None:
    """A case has the seeds of its forecasts in every year."""
    record(tmp_path / "record", (2015, 2016))
    run_here(tmp_path / "record", SEASONS_GRID)
    report = report_of(tmp_path / "record" / "out")
    figures = figures_of(report)
    assert list(figures) == ["deviation-1", "events-1"]
    for name, figure in figures.items():
        figure.save(tmp_path)
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    for case in report.cases:
        assert [*case.totals] == [2015, 2016]
        assert all(len(of_year) == len(case.runs) / 2 for of_year in case.totals.values())
    assert [(case.label, len(case.runs)) for case in report.cases] == [
        ("onoff, forecast perfect", 2), ("mpc, forecast errors skill real", 4)
    ]
