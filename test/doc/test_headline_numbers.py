"""The figures of the README are those of the runs, tables and pictures that it names."""

from __future__ import annotations

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


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_season_is_as_the_readme_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """The season that the example simulates."""
    monkeypatch.chdir(CHECKOUT)
    names: dict[str, Any] = {}
    exec((CHECKOUT / "examples" / "one_season.py").read_text(encoding="utf-8"), names)
    closed, drain, plan = (
        f"{run['wet_discharge_m3']:.1f} m³" for run in names["runs"].table.to_dicts()
    )
    assert f"in the season of 2021, {closed} reaches the sewer in wet weather" in README
    assert f"{drain} if it drains the cistern to a fixed reserve, and {plan} with a plan" in README


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

    for begins, name in (
        ("valve closed", "closed"),
        ("`drain` to 3 m³", "drains the cistern to 3 m³ in dry weather, without a forecast"),
        ("`plan`, perfect forecast", "follows a plan based on a perfect forecast"),
    ):
        discharge, mains = row(begins)[2].split(" / ")
        assert f"| {name} | {discharge} m³ | {mains} m³ |" in README
    without, plan = (row(f"50 % | {outlet}")[3] for outlet in ("overflow only", "valve, plan"))
    text = f"[{without} % less reaches it in wet weather, or {plan} % less with valves]"
    assert text in README
