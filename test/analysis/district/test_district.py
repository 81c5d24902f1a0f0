"""The command: its files and its page."""

from __future__ import annotations

import csv
import os
from pathlib import Path

import pytest
from browsers import drawn_page
from commands import run_command
from studies import edit_district, write_district

import greenroof_ros as gr


def test_command(tmp_path: Path) -> None:
    """Tables and page agree with each other, and with Python with one thread."""
    write_district(tmp_path, edit_district("07-07/07-09", "07-08/07-08"))
    command = "district", "district.yaml", "--output", "out", "--jobs", "2"
    result = run_command(*command, cwd=tmp_path, env=dict(os.environ))
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    rows = list(csv.DictReader((out / "results.csv").open()))
    assert len(rows) == 1 + 5 * 3
    buildings = list(csv.DictReader((out / "buildings.csv").open()))
    half = [row for row in buildings if float(row["adopts_at"]) <= 0.5]
    assert (len(buildings), len(half)) == (8, 4)
    of_half = next(row for row in rows if (row["outlet"], row["adoption"]) == ("drain", "0.5"))
    mains = sum(float(row["drain:mains_m3"]) for row in half)
    assert float(of_half["mains_m3"]) == pytest.approx(mains)
    assert of_half["discharge_m3"] == of_half["discharge_m3_p5"] == of_half["discharge_m3_p95"]
    assert "<script" not in (out / "page.html").read_text()
    with drawn_page(out / "page.html") as page:
        assert "8 buildings" in page.inner_text("h1")
        assert page.locator("table").first.locator("tbody tr").count() == len(rows)
        titles = page.locator("h2").all_inner_texts()
        assert {"What it rests on", "What was read", "How it was made"} <= {*titles}
    in_python = gr.district(tmp_path / "district.yaml")
    assert in_python.table.write_csv() == (out / "results.csv").read_text()
    assert in_python.buildings.write_csv() == (out / "buildings.csv").read_text()
    assert in_python.sentence in " ".join(result.stdout.split())
    (out / "own.txt").touch()
    again = run_command(*command, cwd=tmp_path, env=dict(os.environ))
    assert again.returncode == 2
    assert "--output = 'out': exists and is not empty" in again.stderr
