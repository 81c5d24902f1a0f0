"""The same season in several years: means and ratios by hand, intervals by another library."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from inputs import figures_of, page_of, report_of, study_of
from studies import record, run_here

from greenroof_ros.analysis.report.drawing import Figure
from greenroof_ros.analysis.report.groups import SEASONS, Report
from greenroof_ros.analysis.report.intervals import Comparison, Deviations, compare, worst_tenth
from greenroof_ros.analysis.report.tables import make_tables
from greenroof_ros.analysis.report.words import cautions, sentences
from greenroof_ros.model.site import edited

YEARS = range(2015, 2026)
ONOFF = {year: 100.0 + 10 * (year - 2015) for year in YEARS}
TOTAL = "total_deviation_m3"


def rows(controller: str, seed: int | None, totals: dict[int, float]) -> list[dict[str, Any]]:
    """Return runs of 16 days, in which the second week is three times as bad as the first."""
    forecast: dict[str, Any] = {"forecast": "perfect"}
    if seed is not None:
        forecast = {"forecast": "errors", "forecast_skill": "real", "forecast_seed": seed}
    return [
        {
            "site": "site.yaml", "weather": f"{year}.csv", "start": f"{year}-05-01T00:00:00-05:00",
            "hours": 384.0, "evapotranspiration": "fao56", **forecast, "controller": controller,
            "initial": "low-low", "cistern_m3": 57.7, "roof_m3": 2.4, "status": "done",
            TOTAL: total, "near_target_hours": 96.0, "saved_m3": 2.0 + (seed or 0),
            "outflow_m3": 1.0, "bound_m3": 50.0,
            "weekly_deviation_m3": f"{total / 8} {3 * total / 8} {total / 2}",
        }
        for year, total in totals.items()
    ]


def deviations(*seeds: dict[int, float]) -> Deviations:
    """Return deviations with one seed for each of these totals."""
    made = Deviations()
    for year in seeds[0]:
        totals = np.array([of_seed[year] for of_seed in seeds])
        made.totals[year] = totals
        made.weeks[year] = totals[:, None] * (1 / 8, 3 / 8)
    return made


def relative_to_onoff(*seeds: dict[int, float]) -> Comparison:
    """Return the comparison with on/off of a controller with one seed for each of these totals."""
    comparison = compare(deviations(*seeds), deviations(ONOFF))
    assert comparison is not None
    return comparison


# --- statistics ----------------------------------------------------------------------------------


def test_a_tenth_regardless_of_the_number_of_values() -> None:
    """Of 26 weeks 2.6, of 260 the same as 26; of five the largest.

    Seeds share the weight of their year: two equal seeds change nothing.
    """
    weeks = np.arange(26.0)
    assert worst_tenth(weeks) == pytest.approx((25 + 24 + 0.6 * 23) / 2.6)
    assert worst_tenth(np.repeat(weeks, 10)) == pytest.approx(worst_tenth(weeks))
    assert worst_tenth(np.arange(5.0)) == 4
    assert deviations(ONOFF, ONOFF).worst_weeks() == pytest.approx(deviations(ONOFF).worst_weeks())


def test_ratios_and_what_is_reported_of_them() -> None:
    """Equal in all years is certain; changing signs contain 1."""
    comparison = relative_to_onoff({year: total * 0.8 for year, total in ONOFF.items()})
    assert comparison.mean == pytest.approx((0.8, 0.8, 0.8))
    assert comparison.worst_weeks == pytest.approx((0.8, 0.8, 0.8))
    assert (comparison.better, comparison.years) == (11, 11)
    assert comparison.difference == pytest.approx(-30)
    comparison = relative_to_onoff({year: total + 30 for year, total in ONOFF.items()})
    assert comparison.better == 0
    assert (comparison.mean.value, comparison.difference) == pytest.approx((180 / 150, 30))
    # Of 22 whole weeks the worst 2.2: the second weeks of 2025, 2024 and a fifth of 2023.
    assert comparison.worst_weeks.value == pytest.approx(1 + 30 * 2.2 / (200 + 190 + 0.2 * 180))
    alternating = {year: total + (-1) ** year * 30 for year, total in ONOFF.items()}
    comparison = relative_to_onoff(alternating)
    assert comparison.mean.low < 1 < comparison.mean.high
    assert comparison.better == 6  # the odd years
    # No interval of two years is narrow, but no deviation is below 0.
    two = {2015: 1.0, 2016: 200.0}
    comparison = compare(deviations(two), deviations(dict.fromkeys(two, 100.0)))
    assert comparison is not None and comparison.mean.low == 0.0
    # If on/off never leaves its target, or for a single year, there is no ratio.
    assert compare(deviations(ONOFF), deviations(dict.fromkeys(YEARS, 0.0))) is None
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

    def worst(years: Any) -> float:
        """Return the ratio to on/off of the worst 2.2 of 22 weeks."""
        weeks = [
            [week for year in years for week in (run[2015 + year] / 8, run[2015 + year] * 3 / 8)]
            for run in (own, ONOFF)
        ]
        return float(np.divide(*(np.sort(weeks)[:, -3:] @ (0.2, 1, 1))))

    def mean(years: Any) -> float:
        return float(np.divide(*(sum(run[2015 + year] for year in years) for run in (own, ONOFF))))

    for interval, statistic in ((comparison.mean, mean), (comparison.worst_weeks, worst)):
        resampled = scipy.stats.bootstrap(
            (range(11),), statistic, method="percentile", vectorized=False, n_resamples=10_000,
            random_state=1,
        ).bootstrap_distribution
        value = statistic(range(11))
        assert interval.value == pytest.approx(value)
        for end, level in ((interval.low, 2.5), (interval.high, 97.5)):
            # With 2000 resamples a percentile is accurate to 0.35.
            near = np.percentile(resampled, [level - 1, level + 1])
            low, high = value + WIDER * (near - value)
            assert low - 1e-5 <= end <= high + 1e-5


# --- a study's cases -----------------------------------------------------------------------------


def test_means_by_hand(tmp_path: Path) -> None:
    """Over years, in each over its seeds; the worst year; the worst tenth of all whole weeks."""
    lower = {year: total - 20 for year, total in ONOFF.items()}
    onoff = rows("onoff", None, ONOFF)
    onoff[0]["rain_kept_share_day"], onoff[1]["rain_kept_share_day"] = 0.5, 0.75
    report = study_of(
        tmp_path / "study", *onoff, *rows("mpc", 1, ONOFF), *rows("mpc", 2, lower)
    )
    case = next(row for row in report.of(SEASONS) if row["controller"] == "mpc")
    assert case[TOTAL] == pytest.approx(150 - 10)
    assert (case["worst_year"], case["worst_year_m3"]) == (2025, 190)
    assert (case["seeds"], case["years"], case["forecast"]) == (2, 11, "errors skill real")
    assert case["saved_m3"] == pytest.approx(3.5)
    assert case["ratio"] == pytest.approx(140 / 50)
    # 44 whole weeks: the worst 4.4 are the second weeks of 2025, 2024, 2025 less 20, 2023, and four
    # tenths of the next, 2024 less 20 or 2022.
    assert case["worst_tenth_m3"] == pytest.approx(
        3 / 8 * (200 + 190 + 180 + 180 + 0.4 * 170) / 4.4
    )
    text = page_of(report)
    for expected in (
        "Means of a season", "2015 to 2025", "11 of 11", "errors skill real", ">25.0<",
        "Deviation relative to on/off",
    ):
        assert expected in text
    # Only a run that is a case of its own lacks its trajectory.
    assert "No trajectory" not in text and not report.single
    # The mean is over years with a storm; without one there is no number.
    table = make_tables(report)[1]
    place = table.header.index("rain kept above 10 mm in 24 h")
    assert [row[place].text for row in table.rows] == ["none", "62.5%"]  # mpc first


def test_reference_is_plain_onoff(tmp_path: Path) -> None:
    """On/off to a lower level is compared with on/off to the target, by the best setting."""
    lower, full, tenth = (
        [{**row, "parameter:fraction": fraction, "parameter:level": level}
         for row in rows("onoff", None, {year: total + more for year, total in ONOFF.items()})]
        for fraction, level, more in ((0.1, 0.9, -30), (1.0, 1.0, 15), (0.1, 1.0, 0))
    )
    report = study_of(tmp_path / "a", *lower, *full, *tenth, *rows("mpc", None, ONOFF))
    ratios = {
        row["setting"] if row["controller"] == "onoff" else "mpc": row["has"].mean.value
        for row in report.relative_to_onoff
    }
    assert ratios == pytest.approx(
        {"fraction 0.1, level 0.9": 0.8, "fraction 1, level 1": 1.1, "mpc": 1}
    )
    table = make_tables(report)[-2]
    assert {row[table.header.index("over")].text for row in table.rows} == {
        "on/off fraction 0.1, level 1 perfect"
    }
    assert not study_of(tmp_path / "b", *lower, *rows("mpc", None, ONOFF)).relative_to_onoff


def minimum(report: Report) -> list[tuple[str, str]]:
    """Return the controller with the smallest deviation, and its forecasts."""
    return [(row["controller"], row["forecast"]) for row in report.smallest]


def test_the_minimum_that_a_site_could_have(tmp_path: Path) -> None:
    """The best with imperfect forecasts or none; a table compares the others with it.

    A controller with only perfect forecasts is in each panel of the figure. If the study has a
    controller only with perfect forecasts, its horizon shows that it uses them.
    """
    lower, lowest = ({year: total - more for year, total in ONOFF.items()} for more in (20, 30))
    onoff, looking = rows("onoff", None, ONOFF), rows("lookahead", 1, lower)
    report = study_of(
        tmp_path / "a", *onoff, *rows("mpc", None, ONOFF), *looking,
        *rows("lookahead", None, lowest),
    )
    assert minimum(report) == [("lookahead", "errors skill real")]
    assert [(row["controller"], row["has"].mean.value > 1) for row in report.relative_to_best] == [
        ("mpc", True), ("onoff", True), ("lookahead", False)
    ]
    (*_, table) = make_tables(report)
    assert table.name.startswith("Deviation relative to the controller with the smallest deviation")
    figure = figures_of(report)["seasons"]
    assert [panel.title[-1] for panel in figure.panels] == [
        "forecasts: perfect", "forecasts: errors skill real"
    ]
    assert [
        {row["series"]: row["v"] for row in of_panel if row["year"] == 2015}
        for of_panel in figure.data.values()
    ] == [{"on/off": 100, "MPC": 100, "lookahead": shown} for shown in (70, 80)]

    perfect = rows("mpc", None, lowest)
    assert minimum(study_of(tmp_path / "b", *onoff, *looking, *perfect)) == [("mpc", "perfect")]
    planning = [{**row, "parameter:horizon": 48} for row in perfect]
    report = study_of(tmp_path / "c", *onoff, *looking, *planning)
    assert minimum(report) == [("lookahead", "errors skill real")]
    # All perfect: the minimum of all; if that is plain on/off itself, no table repeats it.
    assert minimum(study_of(tmp_path / "d", *onoff, *perfect)) == [("mpc", "perfect")]
    report = study_of(tmp_path / "e", *rows("onoff", None, lower), *rows("mpc", None, ONOFF))
    assert [table.name for table in make_tables(report)][-1] == "Deviation relative to on/off"


def failed(run: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a run that failed."""
    return {**run, "status": "failed", "error": "no solution", TOTAL: "", "weekly_deviation_m3": ""}


def test_who_failed_in_the_worst_years_is_not_the_minimum(tmp_path: Path) -> None:
    """Two percent more in every year is more, also without the two worst years or their seeds.

    Without those years lookahead's mean is 122.4 m3, with them the on/off controller's is 130 m3.
    Its comparison with on/off is in the five years of both.
    """
    seven = {year: ONOFF[year] for year in range(2015, 2022)}
    more = {year: 1.02 * total for year, total in seven.items()}
    onoff = rows("onoff", None, seven)
    five = [
        failed(row) if row["weather"] > "2020" else row for row in rows("lookahead", None, more)
    ]
    report = study_of(tmp_path / "a", *onoff, *five)
    assert minimum(report) == [("onoff", "perfect")] and not report.relative_to_best
    assert "deviation of a season was 130.00 m³, 2.6 times the minimum possible (on/off, " \
        in sentences(report)[1]
    (compared,) = report.relative_to_onoff
    assert compared["has"].mean.value == pytest.approx(1.02) and compared["has"].years == 5
    assert "lookahead ran in 5 of 7 years: its mean is of other years" in cautions(report)

    # The same for the worse of two seeds in these years, and for the on/off controller's settings.
    better, worse = (
        {year: share * total for year, total in seven.items()} for share in (0.8, 1.24)
    )
    seeds = rows("lookahead", 1, better) + [
        failed(row) if row["weather"] > "2020" else row for row in rows("lookahead", 2, worse)
    ]
    half, full = ([{**row, "parameter:fraction": fraction} for row in runs] for fraction, runs in (
        (0.5, [{**row, "controller": "onoff"} for row in five]), (1.0, onoff),
    ))
    report = study_of(tmp_path / "b", *half, *full, *seeds)
    (case,) = (row for row in report.of(SEASONS) if row["controller"] == "lookahead")
    assert case[TOTAL] == pytest.approx((1.02 * 600 + 0.8 * 310) / 7)  # less than 130
    assert minimum(report) == [("onoff", "perfect")]
    assert {row["setting"] for row in report.plain_onoff} == {"fraction 1"}
    assert cautions(report)[-2:] == [
        "on/off fraction 0.5 ran in 5 of 7 years: its mean is of other years",
        "lookahead (forecast errors skill real) ran with as few as 1 of 2 seeds: its mean is of "
        "other seeds",
    ]
    (table, *_) = make_tables(report)
    place = table.header.index("fewest seeds in a year")
    assert [row[place].text for row in table.rows] == ["1"] * 3

    # If no controller has all years, none is called the best; on/off is still compared with.
    report = study_of(tmp_path / "c", failed(onoff[0]), *onoff[1:], *five)
    assert not report.smallest and len(report.relative_to_onoff) == 1
    assert "it is open which has the smallest mean deviation" in sentences(report)[1]
    many = [{**row, "controller": f"mine_{n}"} for n in range(4) for row in five]
    assert cautions(study_of(tmp_path / "d", *onoff, *many))[-1] == (
        "1 more controllers or settings lack years or seeds"
    )


def test_a_tie_between_seasons_names_all(tmp_path: Path) -> None:
    """As between single runs; of more than three seasons it is treated as shared."""
    report = study_of(tmp_path / "a", *rows("onoff", None, ONOFF), *rows("mpc", None, ONOFF))
    assert "(MPC, forecast perfect, and on/off, forecast perfect)" in sentences(report)[1]
    assert not report.relative_to_best  # on/off is among them
    report = study_of(tmp_path / "b", *(
        {**row, "initial": "custom", "cistern_m3": volume,
         TOTAL: row[TOTAL] + (volume > 2 and row["controller"] == "mpc")}
        for volume in (1.0, 2.0, 3.0, 4.0)
        for row in (*rows("onoff", None, ONOFF), *rows("mpc", None, ONOFF))
    ))
    assert sentences(report)[1].endswith("was shared in 2 and with on/off in 2.")


# --- from the grid to the figures ----------------------------------------------------------------

SEASONS_GRID = """
site: {file: site.yaml, tau: 600.0}
weather:
  - {file: "{year}_*.csv", start: "{year}-05-01T00:00", year: {from: 2015, to: 2016}, hours: 192,
     evapotranspiration: fao56}
bound_block: 3600
forecast: {model: errors, skill: real, seed: {from: 1, to: 2}}
initial: low-low
controllers:
  onoff: {forecast: perfect}
  mpc: {weight: 0.01}
"""
SIZES = """
site: {file: site_catchment.yaml, tau: 600.0, a1: [2.0, 8.0]}
weather:
  - {file: "2015_*.csv", start: 2015-05-01T00:00, hours: 192, evapotranspiration: fao56}
  - {file: "2016_*.csv", start: 2016-05-01T00:00, hours: 192, evapotranspiration: fao56}
bound_block: 0
initial: [site, {name: full, cistern_level: 3.0, roof_level: 0.039}]
controllers: {onoff: }
"""


def seasons(directory: Path, text: str) -> tuple[Report, dict[str, Figure]]:
    """Run a grid of a week and a day in two years; return its report, with its saved figures."""
    record(directory, (2015, 2016))
    run_here(directory, text)
    report = report_of(directory / "out")
    assert not report.single
    years = {tuple(year for year, _ in report.years(row)) for row in report.of(SEASONS)}
    assert years == {(2015, 2016)}
    figures = figures_of(report)
    for name, figure in figures.items():
        figure.save(directory)
        assert (directory / f"{name}.png").stat().st_size > 10_000
    return report, figures


def test_a_study_of_seasons(tmp_path: Path) -> None:
    """A case has the seeds of its forecasts, and a season its whole weeks."""
    report, figures = seasons(tmp_path / "record", SEASONS_GRID)
    assert list(figures) == ["seasons", "season-comparisons"]
    cases = report.of(SEASONS)
    assert all(row["ratio"] > 1 for row in cases)
    for weeks, total in report.table.select("season", TOTAL).iter_rows():
        assert len(weeks) == 1 and 0 < weeks[0] < total
    assert {row["seeds"] for row in cases} == {1, 2}


def test_a_study_of_sizes(tmp_path: Path) -> None:
    """The same roof: what its cistern does not hold comes from the mains."""
    report, figures = seasons(tmp_path / "record", SIZES)
    assert list(figures) == ["sizing"]
    small, _, large, full = report.of(SEASONS)
    assert {row["series"] for row in figures["sizing"].data["sizing-1"]} == {
        "on/off, from site", "on/off, from full",
    }
    assert f"{full['saved_m3']:.4g} m³ a season with a cistern of 24" in sentences(report)[1]
    assert small["outflow_m3"] > large["outflow_m3"] >= 0
    for row in (small, large):
        assert row["saved_m3"] == pytest.approx(row["pumped_m3"] - row["mains_m3"])
    # A roof of half the area is another size, too; a difference in anything else is not.
    study = tmp_path / "record" / "out"
    site = study / "configuration" / small["site"]
    site.write_text(edited(site, {"a2": 34.4}))
    assert len(figures_of(report_of(study))["sizing"].panels) == 2 * 2
    site.write_text(edited(site, {"pump_efficiency": 0.7}))
    assert report.sizing and not report_of(study).sizing
