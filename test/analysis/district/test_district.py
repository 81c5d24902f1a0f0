"""The command: its files, threads and a Dask cluster that loses a worker, and its ends."""

from __future__ import annotations

import csv
import json
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
from dask_cluster import Dask
from districts import DISTRICT, WEATHER, edit, write_district
from graphs import wait_for

import greenroof_ros as gr
from greenroof_ros.analysis.district.page import COLUMNS
from greenroof_ros.analysis.district.run import distribute_district, read_run, simulate_district
from greenroof_ros.analysis.district.totals import Flow
from greenroof_ros.analysis.workers.cluster import cluster
from greenroof_ros.base.errors import ConfigurationError

SHORT = edit("hours: 72", "hours: 24").replace("T00:00", "T20:00")


def district(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the command until it ends."""
    return run_command("district", "district.yaml", *options, cwd=directory, env=dict(os.environ))


def test_command(tmp_path: Path) -> None:
    """Tables, hydrographs, page and SWMM's files agree with each other, and with Python's."""
    write_district(tmp_path, SHORT)
    result = district(tmp_path, "--output", "out", "--jobs", "2", "--swmm")
    assert result.returncode == 0, result.stderr
    assert "less storm water reaches the sewer" in result.stdout
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
        lines = (out / "swmm" / f"{name}.dat").read_text().splitlines()
        assert lines[2].startswith("07/07/2021 20:00:00 ")
        assert lines[-1].startswith("07/08/2021 20:00:00 ")
    buildings = list(csv.DictReader((out / "buildings.csv").open()))
    assert len(buildings) == 8
    half = [row for row in buildings if float(row["adopts_at"]) <= 0.5]
    assert len(half) == 4
    mains = sum(
        float(row["drain:mains_m3"] if row["low_outlet"] == "true" else row["none:mains_m3"])
        for row in half
    )
    of_half = next(row for row in rows if (row["outlet"], row["adoption"]) == ("drain", "0.5"))
    assert float(of_half["mains_m3"]) == pytest.approx(mains)
    assert len(list((out / "figures").glob("*.svg"))) == 3
    with drawn_page(out / "page.html", 7) as page:
        assert "8 buildings" in page.inner_text("h1")
        assert page.locator("table tbody tr").count() == len(rows)
        headers = page.locator("table thead th").all_inner_texts()
        assert len(headers) == 2 + len(COLUMNS)
    in_python = gr.district(tmp_path / "district.yaml")
    assert in_python.table.write_csv() == (out / "results.csv").read_text()
    assert in_python.buildings.write_csv() == (out / "buildings.csv").read_text()
    assert in_python.sentence.replace("\xa0", " ") in result.stdout.replace("\n", " ")
    again = district(tmp_path, "--output", "out")
    assert again.returncode == 2
    assert "--output = 'out': exists and is not empty" in again.stderr


def test_threads_and_dask_with_a_killed_worker(
    dask: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same to the bit: what the killed worker had begun is done again, and counted once."""
    monkeypatch.setattr("greenroof_ros.analysis.district.run._PART", 2)
    run = read_run(write_district(tmp_path, SHORT))
    dask.start_worker()
    dask.start_worker()
    one, here = (simulate_district(run, threads) for threads in (1, 2))
    seen: list[float] = []

    def kill(_: str, share: float) -> None:
        seen.append(share)
        if 0 < share < 1 and dask.workers[0].poll() is None:
            dask.workers[0].kill()
            dask.wait_for_log("Remove worker")

    with cluster(dask.address, run.files) as workers:
        there = distribute_district(run, workers, kill)
    assert dask.workers[0].poll() is not None
    assert seen[-1] == 1
    for other in (here, there):
        assert json.dumps(one.rows()) == json.dumps(other.rows())
        for flow in one.flows:
            assert one.discharge(flow).tobytes() == other.discharge(flow).tobytes()
    assert one.discharge(Flow("plan", 1.0)).sum() > 0


def test_a_wrong_building_is_named(tmp_path: Path) -> None:
    """What two of its values together make wrong is found when its part begins."""
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
    ("{z_veg: {values: [0.07]}}", ",0.1", "district.yaml, line 4: draw.z_veg = 0.07: must be"),
    ("{cistern_height: {values: [0.1]}}", "", "below z_o = 0.1 m"),
    ("{cistern_height: {values: [0.05]}}", "", ", but 0.05 was drawn; change its values"),
    ("{substrate: {names: [loam]}}", ",0.108", "houses.csv, line 2: z_veg = 0.039: "),
])
def test_a_value_that_was_drawn_is_of_the_districts_file(
    tmp_path: Path, keys: str, row: str, message: str
) -> None:
    """Even if other values of the building are listed."""
    column = ",substrate_depth" * bool(row)
    (tmp_path / "houses.csv").write_text(f"id{column}\nA{row}\n")
    write_district(tmp_path, f"""
site: site_valve.yaml
file: houses.csv
draw: {keys}
weather: {{file: {WEATHER}, start: 2021-07-07T00:00, hours: 3}}
""")
    result = district(tmp_path, "--output", "out")
    assert result.returncode == 2
    assert message in result.stderr.splitlines()[-1], result.stderr
    for name, drawn in (("z_o", "cistern_height = 0.1"), ("csv", "substrate = loam")):
        if name in message:
            assert result.stderr.rstrip().endswith(f"(building A; drawn: {drawn})")


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
    with pytest.raises(ConfigurationError, match="is not empty"):
        result.save(tmp_path)


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
