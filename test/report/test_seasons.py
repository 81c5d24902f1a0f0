"""The same season in several years: means and ratios by hand, intervals by another library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from places import CONFIG
from studies import grid, record, study
from test_report import write_study

from greenroof_ros.model.site import read_site
from greenroof_ros.report.assessment import Assumptions
from greenroof_ros.report.entries import Season
from greenroof_ros.report.figures import make_figures
from greenroof_ros.report.page import render
from greenroof_ros.report.results import Report
from greenroof_ros.report.runs import find_runs
from greenroof_ros.report.season_figures import by_year
from greenroof_ros.report.season_tables import season_tables
from greenroof_ros.report.seasons import (
    Comparison,
    Place,
    Seasons,
    comparisons,
    least_deviation,
    plain_onoff,
    seasons,
    split_by_years,
    worst_tenth,
)
from greenroof_ros.report.sizing import is_sizing

HEADER = [
    "run", "site", "weather", "start", "hours", "evapotranspiration", "forecast", "forecast_skill",
    "forecast_seed", "controller", "parameter:fraction", "parameter:level", "initial",
    "cistern_m3", "roof_m3", "status", "error", "total_deviation_m3", "weekly_deviation_m3",
    "near_target_hours", "saved_m3", "outflow_m3", "bound_m3",
]
YEARS = range(2015, 2026)


def rows(controller: str, seed: int | None, totals: dict[int, float]) -> list[dict[str, Any]]:
    """Return runs of a fortnight and two days, the second week three times as bad as the first."""
    forecast: dict[str, Any] = {"forecast": "perfect"}
    if seed is not None:
        forecast = {"forecast": "errors", "forecast_skill": "real", "forecast_seed": seed}
    return [
        {
            "site": "site.yaml", "weather": f"{year}.csv", "start": f"{year}-05-01T00:00:00-05:00",
            "hours": 384.0, "evapotranspiration": "fao56", **forecast, "controller": controller,
            "initial": "low-low", "cistern_m3": 57.7, "roof_m3": 2.4, "status": "done",
            "total_deviation_m3": total, "near_target_hours": 96.0, "saved_m3": 2.0 + (seed or 0),
            "outflow_m3": 1.0, "bound_m3": 50.0,
            "weekly_deviation_m3": f"{total / 8} {3 * total / 8} {total / 2}",
        }
        for year, total in totals.items()
    ]


def report_of(directory: Path, *runs: dict[str, Any]) -> Report:
    """Return the report of a study of seasons alone."""
    path = write_study(directory / "study", [(row, None) for row in runs], HEADER)
    others, found = split_by_years(find_runs([path], None).runs)
    assert not others
    return Report([], [], found)


ONOFF = {year: 100.0 + 10 * (year - 2015) for year in YEARS}


def comparison(directory: Path, *others: dict[int, float]) -> Comparison:
    """Return what a controller with a seed for each of these totals has over on/off."""
    own = [row for seed, totals in enumerate(others, 1) for row in rows("mpc", seed, totals)]
    (found,) = over_onoff(seasons(report_of(directory, *rows("onoff", None, ONOFF), *own)))
    return found


def over_onoff(found: Sequence[Seasons]) -> list[Comparison]:
    """Return what each has over plain on/off."""
    return list(comparisons(found, plain_onoff(found)))


def test_means_by_hand(tmp_path: Path) -> None:
    """Over years, of each over its seeds; the worst year; the worst tenth of all whole weeks."""
    lower = {year: total - 20 for year, total in ONOFF.items()}
    report = report_of(
        tmp_path, *rows("onoff", None, ONOFF), *rows("mpc", 1, ONOFF), *rows("mpc", 2, lower),
    )
    one = next(one for one in seasons(report) if one.controller == "mpc")
    assert one.mean("total_deviation_m3") == pytest.approx(150 - 10)
    assert (one.worst_year, one.seeds, one.forecast) == (2025, 2, "errors skill real")
    assert one.mean("saved_m3") == pytest.approx(3.5)
    assert one.ratio_to_bound == pytest.approx(140 / 50)
    # 44 whole weeks: the worst 4.4 are the second weeks of 2025, 2024, 2025 less 20, 2023, and
    # of the next, 2024 less 20 or 2022, four tenths.
    assert one.worst_weeks == pytest.approx(3 / 8 * (200 + 190 + 180 + 180 + 0.4 * 170) / 4.4)
    text = render(report, [], find_runs([tmp_path / "study"], None), Assumptions())
    for expected in ("Means of a season", "2015 to 2025", "11 of 11", "errors skill real"):
        assert expected in text


def test_years_without_a_storm_have_no_share_of_it(tmp_path: Path) -> None:
    """The mean is of those with one; who has none, or no mains, has no number."""
    wet, dry = rows("onoff", None, ONOFF), rows("mpc", 1, ONOFF)
    wet[0]["rain_kept_share_day"], wet[1]["rain_kept_share_day"] = 0.5, 0.75
    path = write_study(
        tmp_path / "study", [(row, None) for row in (*wet, *dry)], [*HEADER, "rain_kept_share_day"]
    )
    report = Report([], [], split_by_years(find_runs([path], None).runs)[1])
    table = season_tables(report)[0]
    place = table.header.index("rain kept above 10 mm in 24 h")
    assert [row[place].text for row in table.rows] == ["none", "62.5%"]  # mpc first


def test_a_tenth_whatever_the_number_of_values() -> None:
    """Of 26 weeks 2.6, of 260 the same as 26; of five the largest."""
    weeks = np.arange(26.0)
    assert worst_tenth(weeks) == pytest.approx((25 + 24 + 0.6 * 23) / 2.6)
    assert worst_tenth(np.repeat(weeks, 10)) == pytest.approx(worst_tenth(weeks))
    assert worst_tenth(np.arange(5.0)) == 4


def test_ratios_and_luck(tmp_path: Path) -> None:
    """The same in all years is no luck; to and fro may be."""
    found = comparison(tmp_path / "a", {year: total * 0.8 for year, total in ONOFF.items()})
    assert found.mean == pytest.approx((0.8, 0.8, 0.8))
    assert found.worst_weeks == pytest.approx((0.8, 0.8, 0.8))
    assert found.mean.verdict == "better" and (found.better, found.years) == (11, 11)
    assert found.difference == pytest.approx(-30)
    found = comparison(tmp_path / "b", {year: total + 30 for year, total in ONOFF.items()})
    assert found.mean.verdict == "worse" and found.better == 0
    assert (found.mean.value, found.difference) == pytest.approx((180 / 150, 30))
    # Of 22 whole weeks the worst 2.2: the second weeks of 2025, 2024 and a fifth of 2023.
    assert found.worst_weeks.value == pytest.approx(1 + 30 * 2.2 / (200 + 190 + 0.2 * 180))
    uneven = {year: total + (-1) ** year * 30 for year, total in ONOFF.items()}
    found = comparison(tmp_path / "c", uneven)
    assert found.mean.verdict == "may be luck" and found.better == 6  # the odd years


# Student's interval of a mean of eleven over the bootstrap's; t and z from tables.
WIDER = 2.22814 / 1.95996 * np.sqrt(11 / 10)


def test_intervals_of_another_library(tmp_path: Path) -> None:
    """With one seed the two stages are one: scipy's percentile bootstrap of the years."""
    random = np.random.default_rng(7)
    own = {year: total + random.normal(-10, 20) for year, total in ONOFF.items()}
    found = comparison(tmp_path, own)

    def worst(years: Any) -> float:
        """Return what the worst 2.2 of 22 weeks have over on/off's."""
        weeks = [
            [week for year in years for week in (one[2015 + year] / 8, one[2015 + year] * 3 / 8)]
            for one in (own, ONOFF)
        ]
        return float(np.divide(*(np.sort(weeks)[:, -3:] @ (0.2, 1, 1))))

    def mean(years: Any) -> float:
        return float(np.divide(*(sum(one[2015 + year] for year in years) for one in (own, ONOFF))))

    for interval, statistic in ((found.mean, mean), (found.worst_weeks, worst)):
        resampled = scipy.stats.bootstrap(
            (range(11),), statistic, method="percentile", vectorized=False, n_resamples=10_000,
            random_state=1,
        ).bootstrap_distribution
        value = statistic(range(11))
        assert interval.value == pytest.approx(value)
        for end, level in ((interval.low, 2.5), (interval.high, 97.5)):
            # Of 2000 resamples a percentile is sure to 0.35.
            near = np.percentile(resampled, [level - 1, level + 1])
            low, high = value + WIDER * (near - value)
            assert low - 1e-5 <= end <= high + 1e-5


def of_totals(controller: str, setting: str, totals: Sequence[float]) -> Seasons:
    """Return seasons of a week with these deviations."""
    return Seasons(
        Place("site.yaml", "fao56", "01 May 00:00", 168.0, "", "low-low"),
        read_site(CONFIG / "site.yaml"), controller, setting, {}, "perfect",
        {
            year: (Season(
                year, "01 May 00:00", 168.0, {"total_deviation_m3": total}, (total,), "perfect",
                "", None,
            ),)
            for year, total in enumerate(totals, 2015)
        },
    )


@pytest.mark.parametrize("years", [4, 11])
def test_luck_is_called_so(years: int) -> None:
    """Of differences that are luck alone, one in twenty is called better or worse."""
    count = 500
    random = np.random.default_rng(3)
    lucky = [
        of_totals("mpc", str(number), 100 + random.normal(0, 10, years)) for number in range(count)
    ]
    found = [
        one.mean.verdict for one in over_onoff([of_totals("onoff", "", [100.0] * years), *lucky])
    ]
    missed = count - found.count("may be luck")
    # Of so many the binomial distribution has 99 % between these.
    low, high = scipy.stats.binom.interval(0.99, count, 0.05)
    assert len(found) == count and low <= missed <= high


def test_reference_is_plain_onoff(tmp_path: Path) -> None:
    """On/off to a lower level is held against that to the target, of those with the least."""
    lower, full, tenth = (
        [{**row, "parameter:fraction": fraction, "parameter:level": level}
         for row in rows("onoff", None, {year: total + more for year, total in ONOFF.items()})]
        for fraction, level, more in ((0.1, 0.9, -30), (1.0, 1.0, 15), (0.1, 1.0, 0))
    )
    report = report_of(tmp_path / "a", *lower, *full, *tenth, *rows("mpc", None, ONOFF))
    found = {
        one.of.setting or one.of.controller: one.mean.value for one in over_onoff(seasons(report))
    }
    assert found == pytest.approx(
        {"fraction 0.1, level 0.9": 0.8, "fraction 1, level 1": 1.1, "mpc": 1}
    )
    table = season_tables(report)[1]
    assert table.name == "Deviation over that of on/off, and how sure that is"
    assert {row[table.header.index("over")].text for row in table.rows} == {
        "on/off fraction 0.1, level 1 perfect"
    }
    report = report_of(tmp_path / "b", *lower, *rows("mpc", None, ONOFF))
    assert not over_onoff(seasons(report))


def test_settings_in_the_order_of_their_values(tmp_path: Path) -> None:
    """Numbers, not texts: 12 before 48 before 120."""
    runs = [
        {**row, "parameter:fraction": value}
        for value in (120.0, 12.0, 48.0) for row in rows("mpc", None, ONOFF)
    ]
    found = seasons(report_of(tmp_path, *runs))
    assert [one.setting for one in found] == ["fraction 12", "fraction 48", "fraction 120"]


def test_a_panel_for_each_kind_of_forecasts(tmp_path: Path) -> None:
    """One that has been given perfect ones alone stands in each; one with real ones, in its own."""
    real = [{**row, "forecast": "ensemble"} for row in rows("anticipating_onoff", 1, ONOFF)]
    looking = [{**row, "forecast": "ensemble"} for row in rows("lookahead", 1, ONOFF)]
    report = report_of(
        tmp_path, *rows("onoff", None, ONOFF), *real, *looking, *rows("lookahead", None, ONOFF),
    )
    figure = by_year(seasons(report))
    shown = {
        panel.title[-1]: {row["series"] for row in figure.data[name]}
        for panel, name in zip(figure.panels, figure.data, strict=True)
    }
    assert shown == {
        "forecasts: ensemble skill real": {"on/off", "lookahead", "anticipating on/off"},
        "forecasts: perfect": {"on/off", "lookahead"},
    }


def test_nothing_is_over_nothing(tmp_path: Path) -> None:
    """A target that dry weather and on/off never leave: no ratio, and a table of means."""
    report = report_of(
        tmp_path, *rows("onoff", None, dict.fromkeys(YEARS, 0.0)), *rows("mpc", None, ONOFF)
    )
    assert not over_onoff(seasons(report))
    assert [table.name for table in season_tables(report)] == ["Means of a season"]


def test_seeds_widen_the_interval(tmp_path: Path) -> None:
    """Where years are alike and seeds are not, what is unsure are the seeds."""
    apart = [{year: total + each for year, total in ONOFF.items()} for each in (-40, 40)]
    found = comparison(tmp_path, *apart).mean
    # A year's mean of two seeds is -40, 0, 0 or 40; that of eleven has a deviation of 8.5, of 150.
    deviation = 40 / np.sqrt(2 * 11) / 150
    assert found.value == pytest.approx(1)
    end = WIDER * 1.96 * deviation
    assert (found.low - 1, found.high - 1) == pytest.approx((-end, end), rel=0.15)


def test_seeds_of_the_other_widen_it_too(tmp_path: Path) -> None:
    """Forecasts of a seed are the same for both; where one has more seeds, each is drawn alone."""
    apart = [{year: total + each for year, total in ONOFF.items()} for each in (-40, 40)]
    runs = [row for seed, totals in enumerate(apart, 1) for row in rows("mpc", seed, totals)]
    for totals in apart:
        runs += rows("lookahead", apart.index(totals) + 1, totals)
    for seed in (1, 2, 3, 4):
        runs += rows("anticipating_onoff", seed, apart[seed % 2])
    found = seasons(report_of(tmp_path, *rows("onoff", None, ONOFF), *runs))
    reference = next(one for one in found if one.controller == "mpc")
    less = {
        one.of.controller: one.mean
        for one in comparisons(found, {reference.place: reference})
    }
    assert less["lookahead"] == pytest.approx((1, 1, 1))
    # As above for two seeds; for four half its variance, and the two together.
    end = WIDER * 1.96 * 40 / 150 * np.sqrt(1 / (2 * 11) + 1 / (4 * 11))
    assert less["anticipating_onoff"].value == pytest.approx(1)
    assert np.subtract(less["anticipating_onoff"][1:], 1) == pytest.approx((-end, end), rel=0.15)
    assert less["onoff"].high - 1 == pytest.approx(
        WIDER * 1.96 * 40 / 150 / np.sqrt(2 * 11), rel=0.15
    )


def test_the_least_that_a_site_could_have(tmp_path: Path) -> None:
    """The best with forecasts that have errors or with none; a table holds the others to it."""
    lower, lowest = (
        {year: total - each for year, total in ONOFF.items()} for each in (20, 30)
    )
    report = report_of(
        tmp_path / "a", *rows("onoff", None, ONOFF), *rows("mpc", None, ONOFF),
        *rows("lookahead", 1, lower), *rows("lookahead", None, lowest),
    )
    ((_, least),) = least_deviation(seasons(report)).items()
    assert (least.controller, least.forecast) == ("lookahead", "errors skill real")
    (*_, table) = season_tables(report)
    assert table.name.startswith("Deviation over that of the controller with the least deviation")
    texts = [[cell.text for cell in row] for row in table.rows]
    at = table.header.index("verdict")
    assert [(row[0], row[2], *row[at - 1 : at + 2]) for row in texts] == [
        ("MPC", "perfect", "+20", "worse", "1.154"),
        ("on/off", "perfect", "+20", "worse", "1.154"),
        ("lookahead", "perfect", "-10", "better", "0.923"),
    ]
    assert all("lookahead" in row[3] and "skill real" in row[3] for row in texts)
    # One that has no forecasts with errors beside it is known by its horizon.
    report = report_of(
        tmp_path / "d", *rows("onoff", None, ONOFF), *rows("mpc", None, lowest),
        *rows("lookahead", 1, lower),
    )
    found = seasons(report)
    ((_, least),) = least_deviation(found).items()
    assert least.controller == "mpc"
    found = [
        replace(one, parameters={"horizon": 48.0}) if one.controller == "mpc" else one
        for one in found
    ]
    ((_, least),) = least_deviation(found).items()
    assert least.controller == "lookahead"
    # All perfect: the least of all; and where it is plain on/off itself no table says it again.
    report = report_of(tmp_path / "b", *rows("onoff", None, ONOFF), *rows("mpc", None, lower))
    ((_, least),) = least_deviation(seasons(report)).items()
    assert least.controller == "mpc"
    report = report_of(tmp_path / "c", *rows("onoff", None, lower), *rows("mpc", None, ONOFF))
    assert len(season_tables(report)) == 2


SEASONS = """
site: {file: site.yaml, tau: 300.0}
weather:
  - {file: "2015_*.csv", start: 2015-05-01T00:00, hours: 192, evapotranspiration: fao56}
  - {file: "2016_*.csv", start: 2016-05-01T00:00, hours: 192, evapotranspiration: fao56}
bound_block: 3600
forecast: {model: errors, skill: real, seed: [1, 2]}
initial: low-low
controllers:
  onoff: {forecast: perfect}
  lookahead: {horizon: 48}
"""
SIZES = """
site: {file: site_catchment.yaml, tau: 300.0, a1: [2.0, 8.0]}
weather:
  - {file: "2015_*.csv", start: 2015-05-01T00:00, hours: 192, evapotranspiration: fao56}
  - {file: "2016_*.csv", start: 2016-05-01T00:00, hours: 192, evapotranspiration: fao56}
bound_block: 0
initial: site
controllers: {onoff: }
"""


@pytest.mark.parametrize("text", [SEASONS, SIZES], ids=["seasons", "sizes"])
def test_a_study_of_seasons(tmp_path: Path, text: str) -> None:
    """From the grid to the figures: a week and a day of two years."""
    record(tmp_path / "record", (2015, 2016))
    done = study(
        tmp_path, grid(tmp_path, text), "--weather", "record", "--no-trajectories",
        "--output", "out",
    )
    assert done.returncode == 0, done.stderr
    sources = find_runs([tmp_path / "out"], None)
    others, runs = split_by_years(sources.runs)
    report = Report([], [], runs)
    found = seasons(report)
    assert not others and {tuple(one.years) for one in found} == {(2015, 2016)}
    figures = [make() for make in make_figures(report, None)]
    names = [figure.name for figure in figures]
    page = render(report, figures, sources, Assumptions())
    for number, figure in enumerate(names):
        assert f'id="{figure}-panel-1"' in page
        figures[number].save(tmp_path)
        assert (tmp_path / f"{figure}.png").stat().st_size > 10_000
    if text is SIZES:
        assert names == ["sizing"]
        # The same roof: what its cistern does not hold, the mains give.
        small, large = found
        assert small.site.a1 < large.site.a1
        assert small.mean("outflow_m3") > large.mean("outflow_m3") >= 0
        for one in (small, large):
            assert one.mean("saved_m3") == pytest.approx(
                one.mean("pumped_m3") - one.mean("mains_m3")
            )
        another = replace(large, site=replace(large.site, pump_efficiency=0.7))
        assert is_sizing([small, large]) and not is_sizing([small, another])
        return
    assert names == ["seasons", "season-comparisons"]
    for one in found:
        ratio = one.ratio_to_bound
        assert ratio is not None and ratio > 1
        for season in one.years[2015]:
            assert len(season.weeks) == 1
            assert 0 < season.weeks[0] < season.metrics["total_deviation_m3"]
    assert {one.seeds for one in found} == {1, 2}
