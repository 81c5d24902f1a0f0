"""The command: the site file and the page that it writes, what it refuses, its input."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from places import DATA
from twins import TWIN, record_rows, write

from greenroof_ros.base.files import shared_directory
from greenroof_ros.site.file import format_site, read_site

PUMPED = replace(TWIN, a_in=300.0, a_hat=-1e6, c_hat=45.0)
PAPER = shared_directory() / "config" / "site.yaml"


def calibrate(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run_command("calibrate", *arguments, cwd=directory, env=environment(0))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory in which the command fitted a twin, starting from the paper's site.

    Its target is more than the roof holds.
    """
    directory = tmp_path_factory.mktemp("command")
    write(record_rows(PUMPED, 32, 2, pumping=True), directory / "twin.csv")
    (directory / "site.yaml").write_text(format_site(read_site(PAPER, {
        "a2": 100.0, "z_veg": 0.06, "z_soil": 0.1, "latitude": 52.5, "longitude": 13.4,
        "utc_offset": 1.0, "a_in": 300.0, "a_hat": -1e6, "c_hat": 45.0,
    })), encoding="utf-8")
    ended = calibrate(
        directory, "twin.csv", "--site", "site.yaml", "-o", "fitted.yaml", "--months", "4-6"
    )
    assert ended.returncode == 0, ended.stderr
    assert "The runoff in the validation period has an NSE of" in ended.stdout
    assert "note: rain " in ended.stderr
    assert "The runoff in the validation period" in (directory / "fitted.html").read_text()
    return directory


def test_the_command_writes_a_site_that_can_be_used(fitted: Path) -> None:
    site = read_site(fitted / "fitted.yaml")
    assert site.field_capacity == pytest.approx(TWIN.field_capacity, rel=0.05)
    assert site.drainage_time == pytest.approx(TWIN.drainage_time, rel=0.1)
    text = (fitted / "fitted.yaml").read_text(encoding="utf-8")
    assert text.startswith("# Fitted to twin.csv by greenroof calibrate.\n")
    top = " ".join(line[2:] for line in text.split("\n\n")[0].splitlines())
    assert "compared: " in top and "target: the fitted roof cannot hold z_veg = 0.06 m" in top
    # Between wilting point and field capacity, 0.1 m deep.
    middle = (site.wilting_point + site.field_capacity) / 2
    assert site.z_veg == pytest.approx(0.1 * middle, rel=1e-4)
    lines = {line.split(":")[0]: line for line in text.splitlines()}
    exponents = re.search(r"fitted, (\S+) to (\S+); not a 95", lines["percolation_exponent"])
    low, high = map(float, exponents.groups())
    assert low <= site.percolation_exponent == TWIN.percolation_exponent <= high
    assert site.z_pump == 0.15  # a value that was not fitted stays


def test_what_was_refused_writes_nothing(fitted: Path, tmp_path: Path) -> None:
    """A roof in dry weeks, which has nothing to fit."""
    site, record = str(fitted / "site.yaml"), str(DATA / "neubrandenburg_dry.csv")
    ended = calibrate(tmp_path, record, "--site", site, "-o", "new.yaml")
    assert ended.returncode == 2
    assert "in a half of its rain, no measured quantity changes" in ended.stderr
    assert list(tmp_path.iterdir()) == []
