"""The command: its files, its page, and its ends."""

from __future__ import annotations

import csv
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import polars as pl
import pytest
from browsers import drawn_page
from commands import Forked, run_command
from districts import DISTRICT, WEATHER, edit, write_district
from graphs import wait_for

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError

SHORT = edit("hours: 72", "hours: 24").replace("T00:00", "T20:00")


def district(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends."""
    return run_command("district", "district.yaml", *options, cwd=directory, env=dict(os.environ))


def test_command(tmp_path: Path) -> None:
    """Tables, hydrographs and page agree with each other, and with Python with two threads."""
    write_district(tmp_path, SHORT)
    result = district(tmp_path, "--output", "out", "--jobs", "2")
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    rows = list(csv.DictReader((out / "results.csv").open()))
    assert len(rows) == 1 + 4 * 3
    flows = pl.read_parquet(out / "hydrographs.parquet")
    assert flows.height == 24 * 60
    assert str(flows["time_utc-05:00"][0]) == "2021-07-07 20:00:00"
    for row in rows:
        share = float(row["adoption"])
        name = f"{row['outlet']}_{100 * share:03g}" if share else "as_is"
        volume = 60 * flows[f"{name}_m3_s"].sum()
        assert float(row["discharge_m3"]) == pytest.approx(volume)
        assert row["discharge_m3"] == row["discharge_m3_p5"] == row["discharge_m3_p95"]
    buildings = list(csv.DictReader((out / "buildings.csv").open()))
    half = [row for row in buildings if float(row["adopts_at"]) <= 0.5]
    assert (len(buildings), len(half)) == (8, 4)
    mains = sum(
        float(row["drain:mains_m3"] if row["low_outlet"] == "true" else row["none:mains_m3"])
        for row in half
    )
    of_half = next(row for row in rows if (row["outlet"], row["adoption"]) == ("drain", "0.5"))
    assert float(of_half["mains_m3"]) == pytest.approx(mains)
    text = (out / "page.html").read_text()
    assert "<script" not in text
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
    again = district(tmp_path, "--output", "out")
    assert again.returncode == 2
    assert "--output = 'out': exists and is not empty" in again.stderr


def test_a_wrong_building_is_named(tmp_path: Path) -> None:
    """What two of its values together make wrong is found when its site is made."""
    (tmp_path / "houses.csv").write_text("id,cistern_volume,cistern_height\nA,5,2\nB,5,0.1\n")
    text = DISTRICT.replace("buildings: 8", "file: houses.csv").replace(
        "  cistern_volume: {low: 1.0, high: 6.0}\n", ""
    )
    write_district(tmp_path, text)
    result = district(tmp_path, "--output", "out")
    assert result.returncode == 2
    error = result.stderr.splitlines()[-1]
    assert error.startswith("error: houses.csv, line 3: low_outlet_level = 0.1: must be "), error
    assert "below z_o = 0.1 m" in error


@pytest.mark.parametrize(("keys", "row", "message"), [
    # The soil holds 63 % of 0.108 m.
    ("{z_veg: {values: [0.07]}}", "", "district.yaml, line 4: draw.z_veg = 0.07: must be"),
    ("{cistern_height: {values: [0.1]}}", "", "(building A; drawn: cistern_height = 0.1)"),
    ("{cistern_height: {values: [0.05]}}", "", ", but 0.05 was drawn; change its values"),
    ("{substrate: {names: [loam]}}", ",0.108", "houses.csv, line 2: z_veg = 0.039: "),
])
def test_a_value_that_was_drawn_is_of_the_districts_file(
    tmp_path: Path, keys: str, row: str, message: str
) -> None:
    """Even if other values of the building are listed."""
    column = ",substrate_depth" * bool(row)
    (tmp_path / "houses.csv").write_text(f"id{column}\nA{row}\n")
    file = write_district(tmp_path, f"""
site: site_valve.yaml
file: houses.csv
draw: {keys}
weather: {{file: {WEATHER}, start: 2021-07-07T00:00, hours: 3}}
""")
    with pytest.raises(ConfigurationError) as raised:
        gr.district(file)
    assert message in str(raised.value)


def test_full_disk(tmp_path: Path) -> None:
    """The error names the file, as for any other; here files can be of 16 kB at most."""
    result = gr.district(write_district(tmp_path, SHORT))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (16_384, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as raised:
            result.save(f"{tmp_path}/out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "hydrographs.parquet" in str(raised.value)


def test_interrupted(tmp_path: Path) -> None:
    """Ctrl-C ends it in one line."""
    write_district(tmp_path, DISTRICT.replace("hours: 72", "hours: 500"))
    process = Forked(
        [sys.executable, "-m", "greenroof_ros", "district", "district.yaml", "--output", "out"],
        cwd=tmp_path, env=dict(os.environ), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )
    wait_for(lambda: (tmp_path / "out").is_dir(), 120, "the output's directory")
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
