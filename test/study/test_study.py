"""Studies: the paper's 30 runs, interruptions, damage, and months."""

from __future__ import annotations

import random
import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import environment, wait_for
from places import DATA, Once
from studies import (
    CONFIG,
    GRID,
    begun,
    edited,
    grid,
    rows_of,
    run_here,
    store_of,
    stored,
    study,
)

import greenroof_ros
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.study import store as store_module
from greenroof_ros.study.__main__ import show


def test_the_papers_table(papers: Path) -> None:
    """All 30 totals are within 0.02 % of the authors' code."""
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


def test_bound_beside_each_run(papers: Path) -> None:
    """The least possible total from low-low is about 4,422 m3; no run is below its bound."""
    rows = rows_of(papers / "results.csv")
    bounds = {row["initial"]: float(row["bound_m3"]) for row in rows}
    assert bounds["low-low"] == pytest.approx(4422, abs=1)
    for row in rows:
        ratio = float(row["total_deviation_m3"]) / bounds[row["initial"]]
        assert float(row["ratio_to_bound"]) == ratio
        assert ratio > 1 - 1e-9


def test_windows_of_july(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three windows of the real month, one with missing hours."""
    text = f"""
site: {{file: site.yaml, tau: 10.0}}
weather:
  file: {DATA / "en_climate_hourly_07-2021.csv"}
  start: [2021-07-08T05:00, 2021-07-16T08:00, 2021-07-20T12:00]
  hours: 12
initial: low-low
controllers: {{onoff: {{fraction: [0.5, 1.0]}}}}
bound_block: 0
"""
    done = run_here(tmp_path, text)
    rows = done.write_tables()
    show(done.cases, rows, done.directory)
    said = capsys.readouterr().out
    assert "NOTE: 2 of 6 runs had missing hours of weather filled in" in said
    assert len(rows) == 6
    for row in rows:
        assert row["evapotranspiration"] == "fao56"
        filled = row["start"].startswith("2021-07-20")
        assert (row["filled_hours"] != 0) == filled
        assert ("dew point: 2021-07-20T12:00-05:00 to" in row["filled"]) == filled
    # 23 mm in the storm of 8 July, over the roof and the inlet.
    storm = 0.023 * (68.8 + 0.2922466566)
    rain = [row["rain_m3"] for row in rows if row["start"].startswith("2021-07-08")]
    assert rain == pytest.approx([storm] * 2, rel=0.03)


@pytest.fixture
def finished(once: Once, tmp_path: Path) -> Path:
    """A separate directory with the finished study of the grid, and its output."""

    def fill(directory: Path) -> None:
        result = study(directory, grid(directory), "--output", "out")
        assert result.returncode == 0, result.stderr
        (directory / "printed").write_text(result.stdout)

    shutil.copytree(once("study-of-the-grid", fill), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_killed_and_gone_on(finished: Path) -> None:
    """Killed at a random moment, twice: the same table, and no run is done twice.

    Outcomes that a power cut left empty, missing or different are made again.
    """
    seed = random.randrange(1000)
    chance = random.Random(seed)
    print("seed", seed)
    killed = finished / "killed"
    killed.mkdir()
    name = grid(killed)

    def outcomes() -> dict[str, bytes]:
        return {run.name: (run / "outcome.json").read_bytes() for run in stored(killed)}

    for count in (1, 3):
        process = begun(killed)
        wait_for(lambda count=count: len(stored(killed)) >= count, 120, f"{count} runs")
        time.sleep(chance.uniform(0, 1))
        process.kill()
        process.communicate()
    there = outcomes()
    result = study(killed, name, "--output", "out")
    assert result.returncode == 0, result.stderr
    (kept,) = re.findall(r"(\d+) of 12 runs are stored already", result.stderr)
    assert int(kept) >= len(there) >= 3
    assert there.items() <= outcomes().items()  # its timings would differ if it had run again
    assert not list((killed / "out" / "runs").glob("*.part"))
    whole = (finished / "out" / "results.csv").read_bytes()
    assert (killed / "out" / "results.csv").read_bytes() == whole

    empty, gone, other, *_ = sorted(stored(killed))
    (empty / "outcome.json").write_text("")
    (gone / "outcome.json").unlink()
    (other / "outcome.json").write_text("[1, 2]")
    (killed / "out" / "bounds.json").write_text("{")
    again = study(killed, name, "--output", "out")
    assert again.returncode == 0, again.stderr
    assert "9 of 12 runs are stored already" in again.stderr
    assert (killed / "out" / "results.csv").read_bytes() == whole
    assert again.stdout == result.stdout == (finished / "printed").read_text()


def refusal(directory: Path, **changes: Any) -> str:
    """Return why the study of the grid in a directory is not continued; its lock is released."""
    try:
        store_of(directory, **changes)
    except ConfigurationError as error:
        return str(error)
    raise AssertionError("nothing was refused")


def test_killed_while_it_began(tmp_path: Path) -> None:
    """Before its configuration was complete: it is begun again if only a study is there.

    While one process works on it, no other may.
    """
    grid(tmp_path)
    configuration = tmp_path / "out" / "configuration"
    configuration.mkdir(parents=True)
    (tmp_path / "out" / ".lock").touch()
    (configuration / "grid.yaml").write_text("a part")
    held = store_of(tmp_path)
    assert (configuration / "grid.yaml").read_text() == GRID
    assert held.outcomes == {}
    assert "is in use by another process" in refusal(tmp_path)
    for other in (".lock", "mine.txt"):
        directory = tmp_path / f"with {other}"
        (directory / "out" / "configuration").mkdir(parents=True)
        grid(directory)
        (directory / "out" / other).touch()
        (directory / "out" / "notes.txt").touch()
        assert "exists, is not empty and is not a study" in refusal(directory)


def test_what_was_begun_is_not_mixed_with_something_else(finished: Path) -> None:
    """Another grid, another engine, other versions."""
    before = (finished / "out" / "results.csv").read_bytes()
    assert "begun with another engine" in refusal(finished, engine="ros")
    assert "begun with other trajectories, or none" in refusal(finished, trajectory_every=None)
    grid(finished, edited("hours: 0.25", "hours: 0.5"))
    result = run_command(
        "study", "grid.yaml", "--output", "out", cwd=finished, env=environment(0)
    )
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "begun with another grid, or other files" in result.stderr
    grid(finished)
    file = finished / "out" / "configuration" / "study.json"
    file.write_text(file.read_text().replace('"osqp": "', '"osqp": "0.'))
    assert "begun with other versions of the code or its packages" in refusal(finished)
    file.write_text("{")
    assert "study.json: is not valid JSON" in refusal(finished)
    assert (finished / "out" / "results.csv").read_bytes() == before


def test_a_run_that_cannot_be_read_now_stays(finished: Path) -> None:
    """A temporary error, as of a network drive, is reported; nothing is deleted or made again."""
    outcome = min(stored(finished)) / "outcome.json"
    kept = outcome.rename(finished / "away")
    outcome.symlink_to(outcome.name)  # to itself: any reader gets ELOOP
    before = {file: file.lstat().st_ino for file in (finished / "out").rglob("*")}
    assert f"{outcome}: cannot be read: Too many levels" in refusal(finished)
    assert {file: file.lstat().st_ino for file in (finished / "out").rglob("*")} == before
    outcome.unlink()
    kept.rename(outcome)
    assert len(store_of(finished).outcomes) == 12


def test_what_decides_whether_a_run_still_counts(
    finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code behind its numbers, and the constants of skills; not the page, nor comments."""
    package = finished / "greenroof_ros"
    shutil.copytree(Path(greenroof_ros.__file__).parent, package)
    monkeypatch.setattr(store_module, "__file__", str(package / "study" / "store.py"))
    for file, text in (
        ("watch/__init__.py", "A = 1\n"), ("model/plant.py", '# a comment\n"""and words"""\n'),
    ):
        with (package / file).open("a") as stream:
            stream.write(text)
        assert len(store_of(finished).outcomes) == 12, file
    with monkeypatch.context() as patch:
        patch.setattr(store_module, "read_skill", lambda _: "other constants")
        assert "other versions of the code or its packages" in refusal(finished)
    for name in ("model/plant.py", "common/files.py", "common/parameter.py", "common/times.py"):
        code = (package / name).read_text()
        (package / name).write_text(f"{code}A = 1\n")
        assert "other versions of the code or its packages" in refusal(finished), name
        (package / name).write_text(code)
