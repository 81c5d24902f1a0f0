"""The tables of results have what the studies that they name give."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from places import CHECKOUT

PAGE = (CHECKOUT / "doc" / "results.md").read_text()
STUDIES = CHECKOUT / "config" / "studies"


def rows(study: str) -> dict[str, list[str]]:
    """Return the first table after a study's command: the cells of each row by its first."""
    _, _, rest = PAGE.partition(f"config/studies/{study}.yaml")
    table = re.search(r"(?:^\|.*\n)+", rest, re.MULTILINE)
    assert table is not None
    lines = [line.strip("|\n ").split(" | ") for line in table[0].splitlines()[2:]]
    return {first.replace("<wbr>", ""): others for first, *others in lines}


def test_every_study_of_the_package_is_named() -> None:
    """Except one that a user's gauge needs, and two on the page about the controllers."""
    named = set(re.findall(r"greenroof study config/studies/(\w+)\.yaml", PAGE))
    assert named == {path.stem for path in STUDIES.iterdir()} - {
        "storm_water_issued", "reach", "whole_openings",
    }


def test_the_papers_runs(papers: Path) -> None:
    table = rows("paper")
    compared = 0
    with (papers / "results.csv").open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            if row["initial"] == "low-low":
                value = float(row["parameter:weight"] or row["parameter:fraction"])
                name = "mpc, `weight`" if row["controller"] == "mpc" else "on/off, `fraction`"
                total, mean = table[f"{name} {value:.5f}".rstrip("0").rstrip(".")]
                assert total.split(" / ")[0] == f"{float(row['total_deviation_m3']):.0f}"
                assert mean == f"{float(row['mean_deviation_mm']):.2f}"
                compared += 1
    assert compared == len(table) == 10
