"""The headline numbers of the README agree with what they are taken from."""

from __future__ import annotations

from pathlib import Path

import polars
import pytest
from doc_commands.blocks import fences
from places import CHECKOUT

README = " ".join((CHECKOUT / "README.md").read_text().split())


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
    assert f"Reproduces all {len(errors)} runs of Yeh and Chapman (2021) within" in README
    assert 3e-5 < max(errors) < 4e-5 and "within 0.004 %" in README


def test_readme_says_what_its_lines_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The volumes below the picture are the ones of the lines above it."""
    monkeypatch.chdir(tmp_path)
    (code,) = (text for _, language, text in fences("README.md") if language == "python")
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    onoff, lookahead = names["storm"].table["pumped_m3"]  # type: ignore[attr-defined]
    assert f"On/off control pumps {onoff:.2f} m³ before the storm" in README
    assert f"pumps {lookahead:.2f} m³ and leaves the rest" in README
    assert (tmp_path / "storm.svg").stat().st_size > 50_000
