"""The results: each table and figure belongs to its file, and each file to its study."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from places import CHECKOUT
from results.__main__ import TABLES
from results.reduction import read, runs, seasons, seeds, write

from greenroof_ros.analysis.study.case_run import run_case, write_inputs
from greenroof_ros.analysis.study.grid import contents, read_grid

sys.path.append(str(CHECKOUT / "doc"))

from result_figures import FIGURES
from result_tables import RESULTS

DOC = CHECKOUT / "doc"


@pytest.mark.parametrize("name", FIGURES)
def test_figure_is_of_its_file(name: str) -> None:
    """'make docs' would draw no other numbers; the tables are tested with all other tables."""
    drawn = (DOC / "_static" / "results" / f"{name}.svg").read_text()
    assert f'data-drawn-from="{FIGURES[name]().digest}"' in drawn
    assert f"(_static/results/{name}.svg)" in (DOC / "results.md").read_text()


def test_page_shows_every_file() -> None:
    """As a table, or as a figure if the numbers make a curve."""
    page = (DOC / "results.md").read_text()
    assert all(f"<!-- table: results {name} -->" in page for name in RESULTS)
    assert {*RESULTS, *FIGURES} == {*TABLES}


def test_every_file_has_its_study() -> None:
    """Each result file is written by a command, and none is missing."""
    stems = {path.stem for path in (DOC / "results").glob("*.csv")}
    assert stems == {*TABLES, "real_seasons"}  # tools/real_seasons writes the last
    assert all(grid.is_file() for grid, _ in TABLES.values())


def test_file_has_the_papers_runs(papers: Path) -> None:
    """Digit for digit without a solver; a solver's last digits depend on the machine."""
    kept = {
        (row["controller"], row["parameter:weight"], row["parameter:fraction"]): row
        for row in read(DOC / "results" / "methods.csv")
        if row["evapotranspiration"] == "published"
    }
    compared = 0
    for row in runs(papers):
        if row["initial"] == "low-low":
            other = kept[row["controller"], row["parameter:weight"], row["parameter:fraction"]]
            for outcome in ("total_deviation_m3", "mean_deviation_mm"):
                if row["controller"] == "onoff":
                    assert row[outcome] == other[outcome]
                assert float(row[outcome]) == pytest.approx(float(other[outcome]), rel=1e-6)
            compared += 1
    assert compared == len(kept) == 10


@pytest.mark.parametrize("controller", ["onoff", "lookahead"])
def test_file_has_what_a_run_gives(controller: str, tmp_path: Path) -> None:
    """A storm and a record in the tests' data, digit for digit."""
    cases = [
        case for case in read_grid(TABLES["windows"][0]) if case.controller.name == controller
    ]
    kept = [
        row for row in read(DOC / "results" / "windows.csv") if row["controller"] == controller
    ]
    assert len(cases) == len(kept) == 3
    write_inputs(contents(cases), tmp_path)
    for case, row in list(zip(cases, kept, strict=True))[1:]:
        assert (case.start, case.evapotranspiration) == (row["start"], row["evapotranspiration"])
        results = run_case(tmp_path, case, None).results
        assert str(results["mean_deviation_mm"]) == row["mean_deviation_mm"]


@pytest.mark.parametrize("name", ["seasons", "horizons"])
def test_a_ratio_is_to_on_offs_mean_deviation(name: str) -> None:
    """On the same roof; both numbers are over all years."""
    rows = read(DOC / "results" / f"{name}.csv")
    onoff = {
        row["site"]: float(row["mean_deviation_mm"]) for row in rows if row["over_onoff"] == "1.0"
    }
    assert len(onoff) == 2
    for row in rows:
        ratio = float(row["mean_deviation_mm"]) / onoff[row["site"]]
        assert ratio == pytest.approx(float(row["over_onoff"]), abs=0.004)


def study(directory: Path, rows: list[dict[str, Any]]) -> Path:
    """Write a study's table, with the values that all its rows share."""
    alike = {"run": "", "site": "site.yaml", "forecast_seed": 1}
    write(directory / "results.csv", [{**alike, **row, "bound_m3": ""} for row in rows])
    return directory


def test_seasons_are_compared_to_on_off(tmp_path: Path) -> None:
    """Half of the deviation of on/off in each of three years gives half, with no width."""
    rows = [
        {
            "run": f"{controller}{year}", "controller": controller, "start": f"{year}-05-01",
            "status": "done", "total_deviation_m3": total * times,
            "mean_deviation_mm": total * times / 10,
            "weekly_deviation_m3": f"{total * times / 4} {total * times * 3 / 4}",
        }
        for controller, times in (("onoff", 1.0), ("lookahead", 0.5))
        for year, total in ((2015, 20.0), (2016, 40.0), (2017, 60.0))
    ]
    onoff, lookahead = seasons(study(tmp_path, rows))
    assert onoff["controller"] == "onoff"
    assert [float(lookahead[name]) for name in ("over_onoff", "low", "high")] == [0.5, 0.5, 0.5]
    assert float(lookahead["mean_deviation_mm"]) == 2.0
    assert (lookahead["better"], lookahead["years"], onoff["better"]) == ("3", "3", "0")


def test_worst_tenth_of_twenty_seeds_is_the_mean_of_two(tmp_path: Path) -> None:
    rows = [
        {"forecast_skill": "real", "controller": "mpc", "mean_deviation_mm": float(seed)}
        for seed in range(1, 21)
    ]
    (row,) = seeds(study(tmp_path, rows))
    assert (float(row["mean_deviation_mm"]), float(row["worst_tenth_mm"])) == (10.5, 19.5)
