"""Studies and districts for the tests: the command, the same in this process, small files."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta, timezone
from pathlib import Path

from commands import Forked, run_command
from places import CONFIG, DATA

from greenroof_ros.analysis.case import Case
from greenroof_ros.analysis.grid import read_grid
from greenroof_ros.analysis.store import StudyStore
from greenroof_ros.analysis.study import run_study

WEATHER = CONFIG / "weather" / "toronto_2021-07.csv"
GRID = f"""
site: {CONFIG / "site.yaml"}
weather:
  - file: {WEATHER}
    start: 2021-07-07T02:00
    hours: 0.25
    evapotranspiration: [published, fao56]
initial: [low-low, {{name: dry, cistern: 40.0, roof: 0.5}}]
controllers:
  mpc:
    weight: [1.0e-3, 0.1]
    max_command: 1.0
  onoff:
"""

JULY = DATA / "en_climate_hourly_07-2021.csv"
# Two storms, with 23 mm and 13 mm within hours; dry days before, between and after them.
DISTRICT = f"""
site: site_valve.yaml
buildings: 8
draw:
  catchment_area: {{mean: 200, sd: 120, low: 60, high: 1000}}
  cistern_volume: {{mean: 3, sd: 2, low: 1.0, high: 6.0}}
  substrate_depth: {{values: [0.08, 0.108]}}
weather: {{file: {JULY}, season: 07-07/07-09}}
draws: 1
forecast: perfect
adoption: [0.25, 0.5, 1.0]
sewer_capacity: 2.0
"""


def study(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the study command until it ends."""
    return run_command("study", *options, cwd=directory, env=dict(os.environ))


def begun(directory: Path, *options: str, **variables: str) -> subprocess.Popen[str]:
    """Start the study command on the grid in a directory, in a separate session."""
    return Forked(
        [sys.executable, "-m", "greenroof_ros", "study", "grid.yaml", "--output", "out", *options],
        cwd=directory, env={**os.environ, **variables}, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )


def cases_of(file: Path) -> list[Case]:
    """Return the runs of a grid."""
    return read_grid(file).cases


def write_inputs(files: Mapping[str, bytes], directory: Path) -> None:
    """Write input files to a directory."""
    for name, content in files.items():
        (directory / name).write_bytes(content)


def store_of(
    directory: Path, *, trajectory_every: float | None = 0.0, output: str = "out"
) -> StudyStore:
    """Begin the study of the grid in a directory, or continue it."""
    grid = read_grid(directory / "grid.yaml")
    return StudyStore(
        directory / output, grid.cases, grid.files.contents, trajectory_every=trajectory_every,
        show=grid.show,
    )


def run_here(directory: Path, text: str) -> StudyStore:
    """Do all runs of a grid."""
    grid(directory, text)
    store = store_of(directory)
    with ThreadPoolExecutor(1) as executor:
        run_study(store, executor=executor)
    store.write_table()
    return store


def stored(directory: Path) -> list[Path]:
    """Return the finished runs of a study."""
    return [run for run in (directory / "out" / "runs").glob("*") if run.suffix != ".part"]


def grid(directory: Path, text: str = GRID) -> str:
    """Write a grid."""
    (directory / "grid.yaml").write_text(text)
    return "grid.yaml"


def rows_of(file: Path) -> list[dict[str, str]]:
    """Read a table."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def edit_grid(old: str, new: str) -> str:
    """Return the grid with a replaced part."""
    assert old in GRID
    return GRID.replace(old, new)


def write_district(directory: Path, text: str = DISTRICT) -> Path:
    """Write a district's file."""
    file = directory / "district.yaml"
    file.write_text(text, encoding="utf-8")
    return file


def edit_district(old: str, new: str) -> str:
    """Return the district with a replaced part."""
    assert old in DISTRICT
    return DISTRICT.replace(old, new)


def archive(directory: Path, rain: float = 4.0) -> None:
    """Write a forecast file ``archive.csv`` that will not come true."""
    lines = ["issued,time,precipitation [mm/h]"]
    lines += [f"2021-07-07T05:00Z,2021-07-07T{hour:02}:00Z,{rain}" for hour in range(5, 22)]
    (directory / "archive.csv").write_text("\n".join(lines) + "\n")


def record(directory: Path, years: Iterable[int]) -> None:
    """Write a weather record of the first days of May of some years."""
    directory.mkdir()
    header = "time,precipitation [mm/h],temperature [degC],dew point [degC],wind speed [km/h],"
    for year in years:
        first = datetime(year, 5, 1, tzinfo=timezone(timedelta(hours=-5)))
        lines = [
            f"{(first + timedelta(hours=hour)).isoformat()},{hour % 50 == year % 50},15,10,9,101"
            .replace("True", "6").replace("False", "0")
            for hour in range(20 * 24)
        ]
        text = "\n".join([f"{header}station pressure [kPa]", *lines, ""])
        (directory / f"{year}_5.csv").write_text(text)
