"""The figures of README and the page of results are those of the runs and pages they name."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

import pytest
from places import CHECKOUT

import greenroof_ros as gr

README = " ".join((CHECKOUT / "README.md").read_text(encoding="utf-8").split())
RESULTS = (CHECKOUT / "doc" / "results.md").read_text(encoding="utf-8")


def test_every_study_of_the_package_is_named() -> None:
    """Except one that a user's gauge needs, and two on the page about the controllers."""
    named = set(re.findall(r"greenroof study config/studies/(\w+)\.yaml", RESULTS))
    assert named == {path.stem for path in (CHECKOUT / "config" / "studies").iterdir()} - {
        "storm_water_issued", "reach", "whole_openings",
    }


def test_the_papers_runs(papers: Path) -> None:
    table = dict(re.findall(r"^\| ((?:mpc|on/off), .*?) \| (.*) \|$", RESULTS, re.MULTILINE))
    with (papers / "results.csv").open(newline="", encoding="utf-8") as stream:
        runs = [row for row in csv.DictReader(stream) if row["initial"] == "low-low"]
    for row in runs:
        value = float(row["parameter:weight"] or row["parameter:fraction"])
        name = "mpc, `weight`" if row["controller"] == "mpc" else "on/off, `fraction`"
        total, _, mean = re.split(r" [/|] ", table[f"{name} {value:.5f}".rstrip("0").rstrip(".")])
        assert total == f"{float(row['total_deviation_m3']):.0f}"
        assert mean == f"{float(row['mean_deviation_mm']):.2f}"
    assert len(runs) == len(table) == 10


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


def test_the_readme_repeats_what_the_pages_state() -> None:
    ranges = re.findall(r"[\d.]+ \([\d.]+ to [\d.]+\)", README)
    seasons = re.findall(r"\| ([\d.]+ \([^)]*\)) m³ \| ([\d.]+) m³ \|", README)
    assert len(ranges) == 5 and len(seasons) == 3
    for text in (*ranges, *(f"| {discharge} / {mains} |" for discharge, mains in seasons)):
        assert text in RESULTS, text
    campaign = (CHECKOUT / "doc" / "explanation" / "fault-campaign.md").read_text(encoding="utf-8")
    ((cases, longest),) = re.findall(r"among the (\d+) cases .* took \*\*(.* s)\*\* until", README)
    assert f"| a drive, its line, power and timeout | {cases} | 0 | {longest} |" in campaign
