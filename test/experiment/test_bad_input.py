"""Wrong options and files: exit code 2, one clear message, no traceback, nothing started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from paper import PAPER_SITE

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.formats.own_csv import read_forecasts
from greenroof_ros.simulate import main
from greenroof_ros.weather.reading import read_weather

HEADER = "time,precipitation [mm/h],published evapotranspiration [mm/day]"
HOUR = "2021-07-07T0{}:00-05:00,{},2.0"


def weather(*lines: str, header: str = HEADER) -> bytes:
    """Return a weather file."""
    return "\n".join([header, *lines, ""]).encode()


HOURS = [HOUR.format(number, 0.0) for number in range(8)]

# name: options, words of the message. Of each rule there is one case; what files are refused,
# test_site.py, test_weather.py and FORECASTS have.
OPTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown-controller": ("--controller pid", ("controller", "pid")),
    "another-controllers": ("--controller onoff --weight 0.1", ("--weight", "onoff", "--fraction")),
    "number-zero": ("--weight 0", ("--weight", "greater than 0")),
    "number-none": ("--weight nan", ("--weight",)),
    "number-broken": ("--noise-seed 0.5", ("must be a whole number from 0 to 2147483647",)),
    "number-or-word": ("--speed fast", ("must be max, or a number greater than 0, is fast",)),
    "cistern-without-roof": ("--cistern 60", ("--cistern and --roof",)),
    "initial-twice": ("--initial low-low --cistern 60 --roof 2", ("--initial",)),
    "hours-broken-tick": ("--hours 0.0001", ("--hours", "whole number of ticks")),
    "start-before-the-file": ("--start 2021-07-06T23:00-05:00", ("2021-07-07T00:00-05:00",)),
    "start-no-time": ("--start yesterday", ("start", "yesterday")),
    "site-absent": ("--site nowhere.yaml", ("nowhere.yaml", "No such file")),
    "weather-endless": ("--weather /dev/zero", ("/dev/zero", "regular file")),
    "output-not-empty": ("--output full", ("--output", "full", "never written over")),
    "output-unwritable": (
        "--output /proc/greenroof --trajectory run.csv", ("--output", "/proc/greenroof")
    ),
    "forecast-unknown": (
        "--forecast perfekt", ("--forecast = 'perfekt'", "perfect, persistence, errors, ensemble")
    ),
    "forecast-file-by-name": ("--forecast file", ("--forecast = 'file'", "a file (.csv, ")),
    "forecast-late": (
        "--forecast late.csv", ("from 2021-07-07T03:00-05:00 on", "2021-07-07T02:00-05:00")
    ),
    "forecast-at-half-past": (
        "--forecast half.csv",
        ("line 2", "issued = '2021-07-07T00:30-05:00'", "whole number of hours from"),
    ),
    "forecast-without-a-seed": (
        "--forecast-seed 1", ("--forecast-seed", "errors and ensemble", "is perfect")
    ),
    "forecast-skill-unknown": (
        "--forecast errors --forecast-skill large", ("--forecast-skill", "real, worse", "large")
    ),
}
FORECAST_HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day]"
MEMBERS = "issued,time,member,precipitation [mm/h]"
ISSUED = "2021-07-07T00:00-05:00"


def forecasts(*lines: str, header: str = FORECAST_HEADER, issued: str = ISSUED) -> bytes:
    """Return a file of forecasts; a line begins with its time."""
    return "\n".join([header, *(f"{issued},{line}" for line in lines), ""]).encode()


FORECASTS: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "weather": (weather(*HOURS), ("line 1", "'time'", "'issued'")),
    "wrong-unit-of-evapotranspiration": (
        forecasts(HOURS[0], header=FORECAST_HEADER.replace("mm/day", "mm/h")),
        ("line 1", "'evapotranspiration [mm/h]'", "'evapotranspiration [mm/day]'"),
    ),
    "no-rain": (forecasts(header="issued,time"), ("line 1", "'precipitation [mm/h]'")),
    "further-column": (
        forecasts(HOURS[0], header=FORECAST_HEADER + ",snow [cm]"), ("snow", "one column too many")
    ),
    "member-last": (
        forecasts(HOURS[0], header=FORECAST_HEADER + ",member"), ("line 1", "'member'")
    ),
    "gap": (forecasts(HOURS[0], HOURS[2]), ("line 3", "time =", "must be 2021-07-07T01:00-05:00")),
    "late-first": (forecasts(HOURS[1]), ("line 2", "must be 2021-07-07T00:00-05:00")),
    "issued-no-time": (forecasts(HOURS[0], issued="noon"), ("line 2", "issued = 'noon'")),
    "unsorted-issues": (
        forecasts(HOURS[0]) + forecasts(HOURS[0], issued="2021-07-06T23:00-05:00", header="#"),
        ("line 4", "issued = '2021-07-06T23:00-05:00'", "order of time"),
    ),
    "member-negative": (
        forecasts("2021-07-07T00:00-05:00,-1,0.0", header=MEMBERS),
        ("line 2", "member = '-1'", "whole number from 0 to 99"),
    ),
    "member-of-many-digits": (
        forecasts(f"2021-07-07T00:00-05:00,{'9' * 5000},0.0", header=MEMBERS),
        ("line 2", "member = '99", "whole number from 0 to 99"),
    ),
    "member-left-out": (
        forecasts(
            "2021-07-07T00:00-05:00,0,0.0", "2021-07-07T00:00-05:00,2,0.0", header=MEMBERS
        ),
        ("line 2", "members 0, 2", "0 to 1"),
    ),
    "member-of-one-issue": (
        forecasts("2021-07-07T00:00-05:00,0,0.0", header=MEMBERS)
        + forecasts(
            "2021-07-07T01:00-05:00,0,0.0", "2021-07-07T01:00-05:00,1,0.0",
            header="#", issued="2021-07-07T01:00-05:00",
        ),
        ("line 4", "2021-07-07T01:00-05:00 has members 0, 1", "0 to 0"),
    ),
    "member-cut-short": (
        forecasts(
            "2021-07-07T00:00-05:00,0,0.0", "2021-07-07T01:00-05:00,0,0.0",
            "2021-07-07T00:00-05:00,1,0.0", header=MEMBERS,
        ),
        ("line 2", "member 1 has 1, member 0 has 2"),
    ),
}


@pytest.mark.parametrize(("options", "words"), OPTIONS.values(), ids=OPTIONS)
def test_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    options: str, words: tuple[str, ...],
) -> None:
    """It is said what is wrong, where, and what would be right; and nothing is left."""
    (tmp_path / "full" / "something").mkdir(parents=True)
    half = forecasts("2021-07-07T00:30-05:00,0.0,2.0", issued="2021-07-07T00:30-05:00")
    (tmp_path / "half.csv").write_bytes(half)
    late = forecasts(HOURS[3], issued="2021-07-07T03:00-05:00")
    (tmp_path / "late.csv").write_bytes(late)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["simulate", *options.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert (ended.value.code, said.out) == (2, "")
    assert said.err.count("error:") == 1, said.err
    message = said.err.partition("error:")[2]
    for word in words:
        assert word in message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("options", "domain_id", "words"),
    [
        ("--controller pid", None, "controller = 'pid'"), ("--hours 0.0001", None, "--hours"),
        # An input, too.
        ("--hours 0.01", "abc", "ROS_DOMAIN_ID = 'abc'"),
        ("--hours 0.01", "300", "ROS_DOMAIN_ID = '300'"),
    ],
)
def test_bringup_refuses_the_same(
    unused_domain: int, tmp_path: Path, options: str, domain_id: str | None, words: str
) -> None:
    """What the controller's name and the run itself refuse; and it leaves nothing."""
    given = environment(unused_domain)
    given["ROS_DOMAIN_ID"] = domain_id or given["ROS_DOMAIN_ID"]
    done = run_command("bringup", *options.split(), cwd=tmp_path, env=given)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("error:") == 1, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_weather_without_evapotranspiration(tmp_path: Path) -> None:
    """It is neither there nor can it be computed."""
    hours = [line.rpartition(",")[0] for line in HOURS]
    (tmp_path / "FILE.csv").write_bytes(weather(*hours, header="time,precipitation [mm/h]"))
    with pytest.raises(ConfigurationError, match=r"FILE\.csv.*evapotranspiration \[mm/day\]"):
        read_weather([tmp_path / "FILE.csv"], PAPER_SITE)


@pytest.mark.parametrize(("content", "words"), FORECASTS.values(), ids=FORECASTS)
def test_refused_forecasts(tmp_path: Path, content: bytes, words: tuple[str, ...]) -> None:
    """Of what only a file of forecasts has; test_records.py has the rules of all CSV."""
    (tmp_path / "FILE.csv").write_bytes(content)
    with pytest.raises(ConfigurationError) as refused:
        read_forecasts(tmp_path / "FILE.csv")
    for word in ("FILE.csv", *words):
        assert word in str(refused.value)


def test_output_that_nobody_reads(tmp_path: Path) -> None:
    """As behind '| head': no message, and the run's directory is whole."""
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros.simulate", "--hours", "0.01", "--json",
         "--output", "run"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )
    assert process.stdout is not None
    process.stdout.close()
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "error" not in errors.lower()
    assert (tmp_path / "run" / "summary.json").exists()
