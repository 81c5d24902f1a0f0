"""``verify --dress`` and ``--dressed``: the file, its benefit, runs with it; wrong use."""

from __future__ import annotations

import csv
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from commands import run_command
from gauges import write_gauge, write_previous_runs

from greenroof_ros.forecast.dressing import read_dressing

DAYS = 100


def command(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command until it ends."""
    return run_command(*arguments, cwd=directory, env={**os.environ, "COLUMNS": "80"})


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a gauge's hours, and forecasts with twice their water, partly of other days.

    The forecasts are previous runs of two days; the service's hours end at their time.
    """
    directory = tmp_path_factory.mktemp("dressed")
    rng = np.random.default_rng(3)
    wet = np.repeat(rng.random(DAYS * 4) < 0.15, 6)
    rain = np.round(wet * rng.gamma(0.7, 2.0, DAYS * 24), 1)
    write_gauge(directory / "gauge.csv", rain)
    write_previous_runs(directory / "archive.csv", {1: 2 * rain, 2: 2 * np.roll(rain, 3)})
    done = command(
        directory, "verify", "--dress", "archive.csv", "--weather", "gauge.csv", "-o", "dressed.csv"
    )
    assert done.returncode == 0, done.stderr
    # Half a day after an issue a live site's default horizon still fits, however short it is.
    assert "written: dressed.csv, 379 issues and 132 h after each" in done.stdout
    assert read_dressing(directory / "dressed.csv").edges[-1] == 48
    (directory / "said.txt").write_text(done.stdout)
    return directory


def test_what_it_is_worth(site: Path) -> None:
    """Sums to the forecasts' end: issued ones have twice the water and a larger error.

    Dressed ones are an archive of ten members, scored by lead like any other.
    """
    rows = [line.split() for line in (site / "said.txt").read_text().splitlines() if " h " in line]
    assert [row[0] for row in rows[:2]] == ["12", "48"]
    for row in rows[:2]:
        issued, dressed, error, less, climate = map(float, row[4:])
        assert issued == pytest.approx(2.0, abs=0.1)
        assert dressed == pytest.approx(1.0, abs=0.1)
        assert less < 0.6 * min(error, climate)
    done = command(
        site, "verify", "archive.csv", "--dressed", "dressed.csv", "--weather", "gauge.csv",
        "--horizon", "24", "-o", "scores.csv",
    )
    assert done.returncode == 0, done.stderr
    assert "dressed by dressed.csv): 400 issues" in " ".join(done.stdout.split())
    with (site / "scores.csv").open() as stream:
        day = list(csv.DictReader(stream))[-1]
    assert day["sum_hours"] == "24"
    assert float(day["bias"]) == pytest.approx(1.0, abs=0.25)  # of one member


def test_a_study_with_dressed_forecasts(site: Path) -> None:
    """The study's deviation equals a single run's, and the table names the file."""
    (site / "grid.yaml").write_text("""
        site: site.yaml
        weather: {file: gauge.csv, start: 2024-04-10T00:00, hours: 6}
        initial: low-low
        controllers: {lookahead: {horizon: 24.0, forecast: [
          archive.csv, {model: archive.csv, dressed: dressed.csv}]}}
    """)
    done = command(site, "study", "grid.yaml", "--no-trajectories", "--output", "study")
    assert done.returncode == 0, done.stderr
    with (site / "study" / "results.csv").open() as stream:
        plain, dressed = csv.DictReader(stream)
    assert (plain["forecast_dressed"], dressed["forecast_dressed"]) == ("", "dressed.csv")
    by_hand = command(
        site, "simulate", "--weather", "gauge.csv", "--start", "2024-04-10T00:00", "--hours", "6",
        "--controller", "lookahead", "--horizon", "24", "--forecast", "archive.csv", "--dressed",
        "dressed.csv", "--json",
    )
    assert by_hand.returncode == 0, by_hand.stderr
    summary = json.loads(by_hand.stdout)
    assert summary["forecast"] == {
        "model": "file", "file": "archive.csv", "dressed": "dressed.csv",
    }
    deviation = summary["total_deviation_m3"]
    assert float(dressed["total_deviation_m3"]) == deviation != float(plain["total_deviation_m3"])


@pytest.mark.parametrize("horizon", [120, 240])
def test_members_that_are_shorter_than_the_horizon(site: Path, horizon: int) -> None:
    """The run says both lengths, and that no rain is assumed in the rest."""
    done = command(
        site, "simulate", "--weather", "gauge.csv", "--start", "2024-04-10T00:00", "--hours", "1",
        "--controller", "lookahead", "--horizon", str(horizon), "--forecast", "archive.csv",
        "--dressed", "dressed.csv",
    )
    assert done.returncode == 0, done.stderr
    said = " ".join(done.stdout.replace("│", " ").split())
    short = "FORECAST 132 h is the longest issue, the horizon 240 h: no rain is assumed after"
    assert (short in said) is (horizon == 240)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ("--dress errors -o new.csv", "FORECASTS = 'errors': must be an archive with --dress: a"),
        ("--dress archive.csv", "--output: must be given once with --dress: FILE.csv, for --d"),
        ("archive.csv --dressed gauge.csv", "gauge.csv, line 1: 'time': the column must be 'iss"),
    ],
)
def test_wrong_use(site: Path, arguments: str, reason: str) -> None:
    """A line that says what would be right, exit code 2, and nothing written."""
    before = sorted(site.iterdir())
    done = command(site, "verify", *arguments.split(), "--weather", "gauge.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"error: {reason}")
    assert sorted(site.iterdir()) == before
