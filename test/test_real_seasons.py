"""The campaign of real seasons, with days of March 2024 that three services forecast."""

from __future__ import annotations

import csv
import json
import os
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from places import DATA
from real_seasons.inputs import (
    NO_RAIN,
    ROOFS,
    SERVICES,
    TOGETHER,
    read_issued,
    site_file,
    weather_file,
    write_inputs,
)
from real_seasons.runs import ONOFF, Case, build, metrics_by_week, write
from real_seasons.table import Row, interval, rows, write_rows

from greenroof_ros.formats.reading import read_archive
from greenroof_ros.model.site import read_site

DAYS = 9
OF_GEM = Case("measured", "GEM", datetime(2024, 3, 5, 12, tzinfo=timezone.utc), 24.0 * DAYS)


@pytest.fixture(scope="module")
def archives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The services' archives, and what GEM forecast a day before as the gauge's record."""
    directory = tmp_path_factory.mktemp("archives")
    for name in SERVICES.values():
        (directory / f"{name}_previous_runs.csv").symlink_to(
            DATA / f"{name}_previous_runs_2024-03.csv"
        )
    with (directory / "gem_global_previous_runs.csv").open() as stream:
        rain = [row[:2] for row in list(csv.reader(stream))[1:]]
    (directory / "gauge_2024.csv").write_text(
        "datetime,rain_mm\n" + "".join(f"{time},{mm}\n" for time, mm in rain)
    )
    return directory


@pytest.fixture(scope="module")
def inputs(archives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The directory of the sites and the weather."""
    directory = tmp_path_factory.mktemp("inputs")
    write_inputs(archives, directory)
    return directory


@pytest.fixture(scope="module")
def of_gem(archives: Path, inputs: Path) -> Path:
    """The file of the run with GEM's forecasts."""
    return write(OF_GEM, archives, inputs)


@pytest.mark.parametrize(("roof", "target"), [
    ("measured", 0.0457), ("measured, target 39 mm", 0.039), ("paper", 0.0457),
])
def test_sites(inputs: Path, roof: str, target: float) -> None:
    """The target in metres, ticks of a minute, and mains, which the paper's site lacks."""
    site = read_site(site_file(inputs, roof))
    assert (site.z_veg, site.tau, site.mains_level, site.mains_flow) == (target, 60.0, 0.85, 5e-4)
    assert (site.drainage_storage is None) is (roof == "paper")
    assert roof in ROOFS


def test_evapotranspiration_adds_up_to_the_months_mean(inputs: Path) -> None:
    """Hour by hour over a day, in mm/day; without sun there is none."""
    with weather_file(inputs).open() as stream:
        day = [float(row[2]) for row in list(csv.reader(stream))[1:25]]
    monthly = read_site(site_file(inputs, "measured")).monthly_evapotranspiration
    assert monthly is not None
    assert np.mean(day) == pytest.approx(monthly[2], rel=0.005)
    assert [hour for hour, mm in enumerate(day) if mm] == list(range(5, 17))


def test_three_services_as_one_ensemble(archives: Path, inputs: Path) -> None:
    """Each issue has the rain of each service, as long as GFS's, the shortest: four days."""
    site = read_site(site_file(inputs, "paper"))
    services = [
        {issue.issued: issue for issue in read_archive(
            archives / f"{name}_previous_runs.csv", site
        ).issues}
        for name in SERVICES.values()
    ]
    one = read_issued(archives, site, TOGETHER)
    assert [issue.issued for issue in one.issues] == [
        time for time in services[0] if time in services[1] and time in services[2]
    ]
    assert len(one.issues) > 4 * DAYS and one.delay == 6.0
    assert max(issue.hours for issue in one.issues) == 96
    for issue in one.issues:
        for member, service in zip(issue.rain, services, strict=True):
            assert member.tolist() == service[issue.issued].rain[0, : issue.hours].tolist()


def test_a_forecast_of_no_rain(archives: Path, inputs: Path) -> None:
    """As long as GEM's, whenever GEM's is issued."""
    site = read_site(site_file(inputs, "paper"))
    dry, gem = (read_issued(archives, site, name) for name in (NO_RAIN, "GEM"))
    for none, issue in zip(dry.issues, gem.issues, strict=True):
        assert (none.issued, none.rain.shape) == (issue.issued, issue.rain.shape)
        assert none.rain.max() == 0.0


@pytest.mark.parametrize(("forecast", "options"), [
    (ONOFF, ("onoff", "--fraction", repr(1 / 60))),
    ("GEM", ("lookahead", "--forecast", "gem_global_previous_runs.csv")),
])
def test_a_run_is_what_the_command_gives(
    archives: Path, inputs: Path, of_gem: Path, forecast: str, options: tuple[str, ...]
) -> None:
    """Digit for digit: 'greenroof simulate' with the site and weather that the tool wrote."""
    done = run_command(
        "simulate", "--site", str(site_file(inputs, "measured")), "--weather",
        str(weather_file(inputs)), "--evapotranspiration", "assumed", "--gaps", "fill", "--start",
        OF_GEM.start.isoformat(), "--hours", str(OF_GEM.hours), "--initial", "low-low", "--json",
        "--controller", *options, cwd=archives, env=dict(os.environ),
    )
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    case = replace(OF_GEM, forecast=forecast)
    file = of_gem if case == OF_GEM else write(case, archives, inputs)
    results = json.loads(file.read_text())[-1]
    assert {name: summary[name] for name in results} == results
    assert results["pumped_m3"] > 0.0 < results["rain_roof_m3"]


def test_results_by_week(archives: Path, inputs: Path, of_gem: Path) -> None:
    """After a week as in a run of a week, then until the end; written whole."""
    first, last = json.loads(of_gem.read_text())
    assert [first] == metrics_by_week(build(replace(OF_GEM, hours=168.0), archives, inputs))
    assert last["total_deviation_m3"] > first["total_deviation_m3"]
    assert [path.name for path in inputs.glob("measured_GEM*")] == ["measured_GEM.json"]


def test_intervals_of_sums_over_weeks() -> None:
    """A constant factor has an interval without width; otherwise the ratio lies within it."""
    weeks = np.random.default_rng(1).gamma(2.0, size=40)
    assert interval(0.9 * weeks, weeks) == pytest.approx((0.9, 0.9, 0.9))
    value, low, high = interval(weeks, np.ones(40))
    assert value == pytest.approx(weeks.mean())
    assert low < value < high


def test_numbers_of_a_roof() -> None:
    """Four equal weeks, so that no interval has a width: all is in proportion.

    In a week on/off deviates by 10 m3, which are 4 mm, and no rain by 8 m3; 6 of 8 m3 of rain run
    off, and in two of its hours plants lack water.
    """
    def weeks(deviation: float) -> list[dict[str, float]]:
        return [
            {
                "total_deviation_m3": week * deviation, "mean_deviation_mm": 0.4 * deviation,
                "pumped_m3": 3.0 * week, "stress_hours": 2.0 * week, "rain_roof_m3": 8.0 * week,
                "rain_kept_share": 0.25,
            }
            for week in (1, 2, 3, 4)
        ]

    made = list(rows("paper", {ONOFF: weeks(10.0), NO_RAIN: weeks(8.0), "GEM": weeks(6.0)}))
    assert {row.measure: row[3:] for row in made if row.forecast == "GEM"} == {
        measure: pytest.approx((value,) * 3) for measure, value in (
            ("mean deviation (mm)", 2.4), ("over on/off", 0.6), ("over no rain", 0.75),
            ("pumped (m³)", 12.0), ("water stress (h)", 8.0), ("rain kept", 0.25),
        )
    }
    assert {row.roof for row in made} == {"paper"}


def test_a_file_has_all_digits(tmp_path: Path) -> None:
    """A number reads as it was."""
    write_rows([Row("paper", "GEM", "rain kept", 1 / 3, 0.25, 0.5)], tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "roof,forecast,measure,value,low,high", "paper,GEM,rain kept,0.3333333333333333,0.25,0.5",
    ]
