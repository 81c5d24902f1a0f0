"""Studies: the bounds of the paper's runs, interruptions, damage, and what may be continued."""

from __future__ import annotations

import random
import re
import shutil
import time
from pathlib import Path
from typing import Any

import pytest
from graphs import wait_for
from places import Once
from studies import GRID, begun, edit_grid, grid, rows_of, store_of, stored, study

from greenroof_ros.analysis.case import Outcome
from greenroof_ros.base.errors import ConfigurationError


def test_bound_next_to_each_run(papers: Path) -> None:
    """The minimum possible total from low-low is about 4,422 m3; no run is below its bound."""
    rows = rows_of(papers / "results.csv")
    bounds = {row["initial"]: float(row["bound_m3"]) for row in rows}
    assert bounds["low-low"] == pytest.approx(4422, abs=1)
    for row in rows:
        assert float(row["total_deviation_m3"]) / bounds[row["initial"]] > 1 - 1e-9


@pytest.fixture
def finished(once: Once, tmp_path: Path) -> Path:
    """A separate directory with the finished study of the grid."""

    def fill(directory: Path) -> None:
        result = study(directory, grid(directory), "--output", "out")
        assert result.returncode == 0, result.stderr

    shutil.copytree(once("study-of-the-grid", fill), tmp_path, dirs_exist_ok=True)
    return tmp_path


def test_killed_and_gone_on(finished: Path) -> None:
    """Killed at a random moment, twice: the same table, and no run is done twice.

    Outcomes and bounds that a power cut left empty, missing or cut short are made again.
    """
    seed = random.randrange(1000)
    chance = random.Random(seed)
    print("seed", seed)
    killed = finished / "killed"
    killed.mkdir()
    name = grid(killed)

    for count in (1, 3):
        process = begun(killed)
        wait_for(lambda count=count: len(stored(killed)) >= count, 120, f"{count} runs")
        time.sleep(chance.uniform(0, 1))
        process.kill()
        process.communicate()
    there = {run / "outcome.json": (run / "outcome.json").stat() for run in stored(killed)}
    result = study(killed, name, "--output", "out")
    assert result.returncode == 0, result.stderr
    (kept,) = re.findall(r"(\d+) of 12 runs are stored", result.stderr)
    assert int(kept) >= len(there) >= 3
    for file, written in there.items():
        assert file.stat().st_mtime_ns == written.st_mtime_ns  # it has not run again
    assert len(list((killed / "out" / "runs").iterdir())) == 12
    whole = (finished / "out" / "results.csv").read_bytes()
    assert (killed / "out" / "results.csv").read_bytes() == whole

    empty, gone, *_ = sorted(stored(killed))
    (empty / "outcome.json").write_text("")
    (gone / "outcome.json").unlink()
    bounds = killed / "out" / "bounds.json"
    bounds.write_text(bounds.read_text()[:-5])
    again = study(killed, name, "--output", "out")
    assert again.returncode == 0, again.stderr
    assert "10 of 12 runs are stored" in again.stderr
    assert (killed / "out" / "results.csv").read_bytes() == whole


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
    output = tmp_path / "out"
    (output / "configuration").mkdir(parents=True)
    for name in (".lock", "configuration/grid.yaml", "notes.txt"):
        (output / name).write_text("a part")
    assert "exists and is neither empty nor a study" in refusal(tmp_path)
    (output / "notes.txt").unlink()
    held = store_of(tmp_path)
    assert (output / "configuration" / "grid.yaml").read_text() == GRID
    assert held.results == {}
    assert "is in use by another process" in refusal(tmp_path)


def test_what_was_begun_is_not_mixed_with_something_else(finished: Path) -> None:
    """Another grid, other trajectories, other versions."""
    before = (finished / "out" / "results.csv").read_bytes()
    assert "started with other trajectory_every" in refusal(finished, trajectory_every=None)
    grid(finished, edit_grid("hours: 0.25", "hours: 0.5"))
    assert "started with other runs" in refusal(finished)
    grid(finished)
    file = finished / "out" / "configuration" / "study.json"
    begun = file.read_text()
    for what in ("osqp", "source", "skill"):
        file.write_text(begun.replace(f'"{what}": "', f'"{what}": "0.'))
        assert "started with other versions" in refusal(finished)
    file.write_text("{")
    assert "started with other" in refusal(finished)
    assert (finished / "out" / "results.csv").read_bytes() == before


def test_a_run_that_cannot_be_read_now_stays(finished: Path) -> None:
    """A temporary error, as of a network drive, is reported; nothing is deleted or made again."""
    outcome = min(stored(finished)) / "outcome.json"
    outcome.unlink()
    outcome.symlink_to(outcome.name)  # to itself: any reader gets ELOOP
    before = {file: file.lstat().st_ino for file in (finished / "out").rglob("*")}
    with pytest.raises(OSError, match="Too many levels") as error:
        store_of(finished)
    assert error.value.filename == str(outcome)
    assert {file: file.lstat().st_ino for file in (finished / "out").rglob("*")} == before


@pytest.mark.parametrize("what", ["outcome", "bounds", "results"])
def test_a_full_disk_is_named(tmp_path: Path, what: str) -> None:
    """For any such file the message has its path; /dev/full is a disk without room."""
    grid(tmp_path, edit_grid("hours: 0.25", "hours: 0.05"))
    store = store_of(tmp_path)
    full = {
        "outcome": tmp_path / "out/runs" / f"{store.cases[0].identity}.part/.outcome.json.part",
        "bounds": tmp_path / "out" / ".bounds.json.part",
        "results": tmp_path / "out" / ".results.csv.part",
    }[what]
    full.parent.mkdir(exist_ok=True)
    full.symlink_to("/dev/full")
    write = {
        "outcome": lambda: store.write_outcome(store.cases[0], Outcome({}, None)),
        "bounds": lambda: store.write_bound("a bound", {}),
        "results": store.write_table,
    }[what]
    with pytest.raises(OSError, match=re.escape(str(full))):
        write()
