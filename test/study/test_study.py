"""Studies: the paper's 30 runs, interruptions, damage, and months."""

from __future__ import annotations

import os
import random
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment, wait_for
from places import CHECKOUT, DATA
from studies import CONFIG, GRID, WEATHER, edited, grid, rows_of, study

import greenroof_ros


def test_the_papers_table(papers: Path) -> None:
    """All 30 totals within 0.02 % of those of the authors' code."""
    rows = rows_of(papers / "results.csv")
    expected = rows_of(CONFIG / "paper" / "totals.csv")
    assert len(rows) == len(expected) == 30
    totals = {}
    for row in rows:
        assert (row["status"], row["error"]) == ("done", "")
        parameter = row["parameter:weight"] or row["parameter:fraction"]
        totals[row["initial"], row["controller"], float(parameter)] = row
    for row in expected:
        mine = totals[row["initial"], row["controller"], float(row["parameter"])]
        assert float(mine["total_deviation_m3"]) == pytest.approx(
            float(row["total_deviation_m3"]), rel=2e-4
        )
        assert float(mine["final_roof_m3"]) == pytest.approx(float(row["final_roof_m3"]), rel=2e-5)
        assert float(mine["max_command"]) == pytest.approx(
            float(row["max_command"]), rel=1e-3, abs=1e-9
        )


def test_killed_and_gone_on(tmp_path: Path) -> None:
    """Killed at a random moment, again and again: the same table, and no run twice."""
    name = grid(tmp_path, edited("0.25", "1"))
    assert study(tmp_path, name, "--output", "undisturbed").returncode == 0
    seed = random.randrange(1000)
    chance = random.Random(seed)
    print("seed", seed)
    runs = tmp_path / "out" / "runs"

    def finished() -> dict[str, bytes]:
        return {
            path.name: (path / "outcome.json").read_bytes()
            for path in runs.glob("*") if path.suffix != ".part"
        }

    for count in (0, 1, 3):
        process = subprocess.Popen(
            [sys.executable, "-m", "greenroof_ros.study", name, "--output", "out"], cwd=tmp_path,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )
        wait_for(lambda count=count: len(finished()) >= count, 120, f"{count} runs")
        time.sleep(chance.uniform(0, 1))
        process.kill()
        process.wait()
    there = finished()
    result = study(tmp_path, name, "--output", "out")
    assert result.returncode == 0, result.stderr
    (kept,) = re.findall(r"(\d+) of 12 runs are there already", result.stderr)
    assert int(kept) >= len(there) >= 3
    assert there.items() <= finished().items()  # its timings would differ, had it run again
    assert not list(runs.glob("*.part"))
    undisturbed = (tmp_path / "undisturbed" / "results.csv").read_bytes()
    assert (tmp_path / "out" / "results.csv").read_bytes() == undisturbed
    again = study(tmp_path, name, "--output", "out")
    assert (again.returncode, again.stdout) == (0, result.stdout)


def test_killed_while_it_began(tmp_path: Path) -> None:
    """Before its configuration was whole: it is begun again, where nothing but a study is."""
    name = grid(tmp_path, edited("0.25", "0.05"))
    (tmp_path / "out" / "configuration").mkdir(parents=True)
    (tmp_path / "out" / ".lock").touch()
    (tmp_path / "out" / "configuration" / "grid.yaml").write_text("a part")
    assert study(tmp_path, name, "--output", "out").returncode == 0
    for other in (".lock", "mine.txt"):
        directory = tmp_path / f"with {other}"
        (directory / "configuration").mkdir(parents=True)
        (directory / other).touch()
        (directory / "notes.txt").touch()
        refused = study(tmp_path, name, "--output", str(directory))
        assert refused.returncode == 2
        assert "is not empty and no study" in refused.stderr


def test_windows_of_july(tmp_path: Path) -> None:
    """Three windows of the real month, one of them with hours that were missing."""
    file = DATA / "en_climate_hourly_07-2021.csv"
    text = GRID.replace(str(WEATHER), str(file)).replace("[published, fao56]", "fao56")
    text = text.replace("  mpc:\n    weight: [1.0e-3, 0.1]\n    max_command: 1.0\n", "")
    text = text.replace("onoff:", "onoff: {fraction: [0.5, 1.0]}").replace("[low-low, ", "[")
    text = text.replace("hours: 0.25", "hours: 12").replace(
        "2021-07-07T02:00", "[2021-07-08T05:00, 2021-07-16T08:00, 2021-07-20T12:00]"
    )
    result = study(tmp_path, grid(tmp_path, text), "--output", "out")
    assert result.returncode == 0, result.stderr
    assert "NOTE: 2 of 6 runs had missing hours of weather filled in" in result.stdout
    rows = rows_of(tmp_path / "out" / "results.csv")
    assert len(rows) == 6
    for row in rows:
        assert row["evapotranspiration"] == "fao56"
        filled = row["start"].startswith("2021-07-20")
        assert (row["filled_hours"] != "0") == filled
        assert ("dew point: 2021-07-20T12:00-05:00 to" in row["filled"]) == filled
    # 23 mm in the storm of 8 July, over the roof and the inlet.
    storm = 0.023 * (68.8 + 0.2922466566)
    rain = [float(row["rain_m3"]) for row in rows if row["start"].startswith("2021-07-08")]
    assert rain == pytest.approx([storm] * 2, rel=0.03)


def test_what_was_begun_is_not_mixed_with_something_else(tmp_path: Path) -> None:
    """Another grid, another engine, other versions, a directory of something else."""
    small = edited("[published, fao56]", "published").replace("    weight: [1.0e-3, 0.1]\n", "")
    assert study(tmp_path, grid(tmp_path, small), "--output", "out").returncode == 0
    before = (tmp_path / "out" / "results.csv").read_bytes()

    def refusal(*options: str) -> str:
        result = run_command(
            "study", "grid.yaml", "--output", "out", *options, cwd=tmp_path, env=environment(0)
        )
        assert result.returncode == 2
        assert result.stderr.count("\n") == 1
        return result.stderr

    assert "begun with another engine" in refusal("--engine", "ros")
    assert "begun with other trajectories, or none" in refusal("--no-trajectories")
    grid(tmp_path, small.replace("hours: 0.25", "hours: 0.5"))
    assert "begun with another grid, or other files" in refusal()
    grid(tmp_path, small)
    file = tmp_path / "out" / "configuration" / "study.json"
    file.write_text(file.read_text().replace('"osqp": "', '"osqp": "0.'))
    assert "begun with other versions of what makes the numbers" in refusal()
    file.write_text("{")
    assert "study.json: is not valid JSON" in refusal()
    assert (tmp_path / "out" / "results.csv").read_bytes() == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("42")
    result = run_command(
        "study", "grid.yaml", "--output", "mine", cwd=tmp_path, env=environment(0)
    )
    assert result.returncode == 2
    assert "exists, is not empty and no study" in result.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_damaged_outcomes_are_made_again(tmp_path: Path) -> None:
    """As a power cut leaves them: empty, gone, something else."""
    name = grid(tmp_path)
    assert study(tmp_path, name, "--output", "out").returncode == 0
    table = tmp_path / "out" / "results.csv"
    before = table.read_bytes()
    runs = sorted((tmp_path / "out" / "runs").iterdir())
    (runs[0] / "outcome.json").write_text("")
    (runs[1] / "outcome.json").unlink()
    (runs[2] / "outcome.json").write_text("[1, 2]")
    (tmp_path / "out" / "bounds.json").write_text("{")
    result = study(tmp_path, name, "--output", "out")
    assert result.returncode == 0, result.stderr
    assert "9 of 12 runs are there already" in result.stderr
    assert table.read_bytes() == before


def test_a_run_that_cannot_be_read_now_stays(tmp_path: Path) -> None:
    """An error of the moment, as of a network drive: said, and nothing is deleted or made again."""
    small = edited("[published, fao56]", "published").replace("    weight: [1.0e-3, 0.1]\n", "")
    name = grid(tmp_path, small)
    assert study(tmp_path, name, "--output", "out").returncode == 0
    runs = tmp_path / "out" / "runs"
    outcome = min(runs.iterdir()) / "outcome.json"
    kept = outcome.rename(tmp_path / "away")
    outcome.symlink_to(outcome.name)  # to itself: ELOOP, whoever reads it
    before = {file: file.lstat().st_ino for file in (tmp_path / "out").rglob("*")}
    result = study(tmp_path, name, "--output", "out")
    assert result.returncode == 2
    assert f"{outcome.relative_to(tmp_path)}: cannot be read: Too many levels" in result.stderr
    assert {file: file.lstat().st_ino for file in (tmp_path / "out").rglob("*")} == before
    outcome.unlink()
    kept.rename(outcome)
    result = study(tmp_path, name, "--output", "out")
    assert result.returncode == 0 and "4 of 4 runs are there already" in result.stderr


def test_what_decides_whether_a_run_still_counts(tmp_path: Path) -> None:
    """The code that makes its numbers: not that of the page, and no comment."""
    package = tmp_path / "greenroof_ros"
    shutil.copytree(Path(greenroof_ros.__file__).parent, package)
    shutil.copytree(CONFIG, tmp_path / "config")
    shutil.copytree(CHECKOUT / "msg_defs", tmp_path / "msg_defs")
    small = edited("[published, fao56]", "published").replace("    weight: [1.0e-3, 0.1]\n", "")
    name = grid(tmp_path, small.replace(str(CONFIG), str(tmp_path / "config")))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}

    def run() -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "greenroof_ros.study", name, "--output", "out"],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )

    assert run().returncode == 0
    for file, text, counts in (
        ("watch/__init__.py", "A = 1\n", True), ("model/plant.py", "# a comment\n", True),
        ("model/plant.py", "A = 1\n", False),
    ):
        with (package / file).open("a") as stream:
            stream.write(text)
        result = run()
        assert ("4 of 4 runs are there already" in result.stderr) is counts, (file, text)
        assert ("other versions of what makes the numbers" in result.stderr) is not counts


def test_bound_beside_each_run(papers: Path) -> None:
    """The least possible total from low-low is about 4,422 m3; no run is below its own."""
    rows = rows_of(papers / "results.csv")
    bounds = {row["initial"]: float(row["bound_m3"]) for row in rows}
    assert bounds["low-low"] == pytest.approx(4422, abs=1)
    for row in rows:
        ratio = float(row["total_deviation_m3"]) / bounds[row["initial"]]
        assert float(row["ratio_to_bound"]) == ratio
        assert ratio > 1 - 1e-9


def test_results_show_both_methods_of_evapotranspiration(papers: Path, tmp_path: Path) -> None:
    """The documentation's table is what the paper's grid gives with both, to the digit shown.

    Of the half with fao56 the page shows two initial states, of which the runs that take longest
    are looked at in part: all of on/off, and two weights.
    """
    text = (CONFIG / "studies" / "paper.yaml").read_text()
    for whole, part in (
        ("evapotranspiration: published", "evapotranspiration: fao56"), (", high-high]", "]"),
        ("[1.0e-5, 1.0e-4, 1.0e-3, 1.0e-2, 1.0e-1]", "[1.0e-5, 1.0e-2]"),
    ):
        assert text.count(whole) == 1
        text = text.replace(whole, part)
    grid(tmp_path, text)
    result = study(tmp_path, "grid.yaml", "--output", "out")
    assert result.returncode == 0, result.stderr
    totals = {
        (
            row["controller"], float(row["parameter:weight"] or row["parameter:fraction"]),
            row["initial"], row["evapotranspiration"],
        ): float(row["total_deviation_m3"])
        for table in (papers, tmp_path / "out") for row in rows_of(table / "results.csv")
    }
    page = (CHECKOUT / "doc" / "results.md").read_text()
    shown = re.findall(
        r"^\| (MPC|on/off) ([\d.]+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", page, re.MULTILINE
    )
    assert len(shown) == 10
    columns = [
        (initial, method) for initial in ("low-low", "high-low")
        for method in ("published", "fao56")
    ]
    seen = 0
    for controller, parameter, *figures in shown:
        name = {"MPC": "mpc", "on/off": "onoff"}[controller]
        for figure, (initial, method) in zip(figures, columns, strict=True):
            key = (name, float(parameter), initial, method)
            if key in totals:
                assert figure == f"{totals[key]:.0f}", key
                seen += 1
    assert seen == 20 + 2 * (2 + 5)
