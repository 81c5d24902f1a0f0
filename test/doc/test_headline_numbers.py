"""The figures of the README are those of the runs, tables and pictures that it names."""

from __future__ import annotations

import datetime as dt
import re
from pathlib import Path
from typing import Any

import polars
import pytest
from places import CHECKOUT

import greenroof_ros as gr

README = " ".join((CHECKOUT / "README.md").read_text(encoding="utf-8").split())


def test_papers_runs_are_reproduced_as_the_readme_says(papers: Path) -> None:
    """The total deviations of all runs, relative to the ones of the authors' code."""
    ours = polars.read_csv(papers / "results.csv").to_dicts()
    theirs = polars.read_csv(CHECKOUT / "config" / "paper" / "totals.csv").to_dicts()
    errors = []
    for row in theirs:
        name = {"mpc": "weight", "onoff": "fraction"}[row["controller"]]
        (total,) = (
            each["total_deviation_m3"] for each in ours
            if (each["initial"], each["controller"]) == (row["initial"], row["controller"])
            and each[f"parameter:{name}"] == row["parameter"]
        )
        errors.append(abs(total / row["total_deviation_m3"] - 1))
    assert f"all {len(errors)} runs of Yeh and Chapman (2021) agree" in README
    assert 3e-5 < max(errors) < 4e-5 and "within 0.004 %" in README


def write_forecast_without_rain(path: Path) -> str:
    """Write issues of three days for every six hours of the season, and return their path."""
    first = dt.datetime(2021, 4, 30, tzinfo=dt.timezone(dt.timedelta(hours=-5)))
    lines = ["issued,time,precipitation [mm/h]"]
    for issue in range(4 * 186):
        issued = first + dt.timedelta(hours=6 * issue)
        lines += (
            f"{issued.isoformat()},{(issued + dt.timedelta(hours=hour)).isoformat()},0.0"
            for hour in range(72)
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return str(path)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_season_is_as_the_readme_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path,
) -> None:
    """The table below the lines of the example, and what the text derives from it."""
    monkeypatch.chdir(CHECKOUT)
    names: dict[str, Any] = {}
    exec((CHECKOUT / "examples" / "one_season.py").read_text(encoding="utf-8"), names)
    closed, drain, plan = names["runs"].table.to_dicts()
    assert f"for {closed['rain_m3']:.1f} m³ of rain" in README
    # By default ten days of irrigation at 4 mm a day.
    reserve = 10 * 0.004 * names["site"].a2
    for run, name in (
        (closed, "closed"),
        (drain, f"drains the cistern to a fixed reserve of {reserve:.2f} m³ in dry weather"),
        (plan, "follows a plan based on a perfect forecast"),
    ):
        wet, total, mains = (
            f"{run[each]:.1f} m³" for each in ("wet_discharge_m3", "discharge_m3", "mains_m3")
        )
        figures = f"{wet} | {total} | {100 * run['retention_share']:.0f} % | {mains}"
        assert f"| {name} | {figures} |" in README

    def less(run: dict[str, float]) -> str:
        return f"**{100 * (1 - run['wet_discharge_m3'] / closed['wet_discharge_m3']):.0f} %**"

    reduces = f"a fixed reserve reduces the discharge in wet weather by {less(drain)}"
    assert f"{reduces}, and a plan based on a perfect forecast by {less(plan)}." in README
    dry = gr.simulate(
        "onoff", outlet="plan", forecast=write_forecast_without_rain(tmp_path / "dry.csv"),
        forecast_delay=0, **names["season"],
    ).metrics
    assert f"never contains rain, `plan` takes {dry['mains_m3']:.1f} m³ from the mains" in README
    wet, perfect = dry["wet_discharge_m3"], plan["wet_discharge_m3"]
    discharged = f"{wet:.1f} m³ reaches the sewer in wet weather"
    errors = gr.simulate("onoff", outlet="plan", forecast="errors", **names["season"]).metrics
    compared = f"{perfect:.1f} m³ with a perfect forecast, and {errors['wet_discharge_m3']:.1f} m³"
    assert f"{discharged}, compared with {compared} with synthetic forecasts" in README
    watering = gr.simulate("lookahead", outlet="closed", **names["season"]).metrics
    assert closed["stress_hours"] == 0
    assert f"plants lack water for {watering['stress_hours']:.0f} hours instead of none" in README
    saved = 1 - watering["pumped_m3"] / closed["pumped_m3"]
    assert f"`lookahead` pumps {100 * saved:.0f} % less" in README


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_storm_is_the_animations() -> None:
    picture = (CHECKOUT / "doc" / "_static" / "storm-animation.svg").read_text(encoding="utf-8")
    full, room = re.findall(r">([0-9.]+) m³ to the sewer in wet weather<", picture)
    text = f"{full} m³ reaches the sewer in wet weather without a valve, and {room} m³ if a valve"
    assert text in README
    storm = gr.simulate(
        "onoff", site=gr.read_site(CHECKOUT / "config" / "site_valve.yaml", tau=60.0, M=1),
        start="2021-07-07T00:00", hours=48,
    )
    assert f"Of {storm.metrics['rain_m3']:.1f} m³ of rain" in README


def test_faults_are_those_of_the_campaign() -> None:
    page = (CHECKOUT / "doc" / "explanation" / "fault-campaign.md").read_text(encoding="utf-8")
    row = re.search(
        r"^\| a drive, its line, power and timeout \| (\d+) \| 0 \| ([0-9.]+ of [0-9.]+ s) \|$",
        page, re.MULTILINE,
    )
    assert row is not None
    assert f"Among the {row[1]} cases with a fault in a drive, its line or its power" in README
    assert f"the one closest to its limit took **{row[2]}**" in README
    day = re.search(r"a complete run of (\d+ \w+ \d{4})", page)
    cases = re.search(r"^\| together \| (\d+) \|", page, re.MULTILINE)
    passed = re.search(r"(\d+) passed at the first attempt", " ".join(page.split()))
    assert day is not None and cases is not None and passed is not None
    assert f"In the run of {day[1]}, {passed[1]} of {cases[1]} cases passed at the first" in README


def test_results_are_those_of_the_page() -> None:
    """The README's means of eleven seasons, and what half of the houses change."""
    page = (CHECKOUT / "doc" / "results.md").read_text(encoding="utf-8")

    def row(begins: str) -> list[str]:
        (line,) = (line for line in page.splitlines() if line.startswith(f"| {begins} |"))
        return line.strip("| ").split(" | ")

    def mean(begins: str) -> str:
        return row(begins)[2].split()[0]

    means = mean("valve closed"), mean("`drain` to 3 m³"), mean("`plan`, perfect forecast")
    text = "the means are {} m³ with a closed valve, {} m³ with a reserve of 3 m³, and {} m³ with a"
    assert text.format(*means) in README
    without, plan = (row(f"50 % | {outlet}")[3] for outlet in ("overflow only", "valve, plan"))
    text = f"[{without} % less reaches it in wet weather, or {plan} % less with valves]"
    assert text in README
