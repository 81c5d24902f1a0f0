"""Studies for the tests: the command, and a small grid."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterable
from datetime import datetime, timedelta, timezone
from pathlib import Path

from greenroof_ros.common.files import shared_directory

CONFIG = shared_directory() / "config"
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


def study(directory: Path, *options: str, timeout: float = 600) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "greenroof_ros.study", *options],
        cwd=directory, capture_output=True, text=True, timeout=timeout, check=False,
    )


def grid(directory: Path, text: str = GRID) -> str:
    """Write a grid."""
    (directory / "grid.yaml").write_text(text)
    return "grid.yaml"


def rows_of(file: Path) -> list[dict[str, str]]:
    """Read a table."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


def edited(old: str, new: str) -> str:
    """Return the grid with something else in it."""
    assert old in GRID
    return GRID.replace(old, new)


def record(directory: Path, years: Iterable[int]) -> None:
    """Write a record of the first days of May of some years."""
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
