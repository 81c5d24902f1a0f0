"""Wrong options and files: exit code 2, one clear message, no traceback, nothing started."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment
from places import CHECKOUT

SITE = (CHECKOUT / "config" / "site.yaml").read_text()
WEATHER = (CHECKOUT / "config" / "weather" / "toronto_2021-07.csv").read_text()
HEADER = "time,precipitation [mm/h],published evapotranspiration [mm/day]"
HOUR = "2021-07-07T0{}:00-05:00,{},2.0"


def weather(*lines: str, header: str = HEADER) -> bytes:
    """Return a weather file."""
    return "\n".join([header, *lines, ""]).encode()


HOURS = [HOUR.format(number, 0.0) for number in range(8)]

# name: options (FILE is the file), the file's bytes (None: there is none), words of the message
OPTIONS: dict[str, tuple[str, tuple[str, ...]]] = {
    "unknown-controller": ("--controller pid", ("controller", "pid")),
    "unknown-initial": ("--initial low", ("--initial", "low-low")),
    "unknown-option": ("--horizon 30", ("--horizon",)),
    "weight-zero": ("--weight 0", ("--weight", "greater than 0")),
    "speed": ("--speed fast", ("--speed", "must be max, or a number greater than 0, is fast")),
    "weight-nan": ("--weight nan", ("--weight",)),
    "fraction-huge": ("--controller onoff --fraction 1e7", ("--fraction", "1e+06")),
    "speed-huge": ("--speed 1e10", ("--speed", "1e+09")),
    "cistern-deep": (
        "--cistern 401 --roof 2.4",
        ("--cistern = 401.0: must be at most 400 m3, a level of 16 m (", "401 mm is 10.025 m3"),
    ),
    "roof-deep": (
        "--cistern 60 --roof 250",
        ("--roof = 250.0: must be at most 159.96 m3", "the soil holds 34.4 m3, 0.5 m",
         "is a unit wrong? It is a volume in m3; a level of 250 mm is 17.2 m3"),
    ),
    "endless-file": ("--weather /dev/zero", ("/dev/zero", "regular file")),
    "weight-for-onoff": ("--controller onoff --weight 0.1", ("--weight", "onoff", "--fraction")),
    "fraction-for-mpc": ("--fraction 0.5", ("--fraction", "mpc", "--weight")),
    "hours-zero": ("--hours 0", ("--hours",)),
    "hours-broken-tick": ("--hours 0.0001", ("--hours", "whole number of ticks")),
    "hours-beyond-the-file": ("--hours 1000", ("toronto_2021-07.csv", "2021-07-10T00:00-05:00")),
    "hours-beyond-time": ("--hours 1e300", ("--hours", "1e+09")),
    "start-before-the-file": ("--start 2021-07-06T23:00-05:00", ("2021-07-07T00:00-05:00",)),
    "start-no-time": ("--start yesterday", ("start", "yesterday")),
    "start-beyond-time": ("--start 9999-12-31T23:00", ("start", "2037")),
    "cistern-without-roof": ("--cistern 60", ("--cistern and --roof",)),
    "initial-twice": ("--initial low-low --cistern 60 --roof 2", ("--initial",)),
    "no-such-site": ("--site nowhere.yaml", ("nowhere.yaml", "No such file")),
    "no-such-weather": ("--weather nowhere.csv", ("nowhere.csv", "No such file")),
    "output-not-empty": ("--output full", ("--output", "full", "never written over")),
    "output-unwritable": ("--output /proc/greenroof", ("--output", "/proc/greenroof")),
    "forecast-unknown": (
        "--forecast perfekt", ("--forecast = 'perfekt'", "perfect, persistence, errors, ensemble")
    ),
    "forecast-file-by-name": ("--forecast file", ("--forecast = 'file'", "a file (.csv, ")),
    "forecast-no-such-file": ("--forecast nowhere.csv", ("nowhere.csv", "No such file")),
    "forecast-seed-for-perfect": (
        "--forecast-seed 1", ("--forecast-seed", "errors and ensemble", "is perfect")
    ),
    "forecast-skill-for-persistence": (
        "--forecast persistence --forecast-skill real", ("--forecast-skill", "is persistence")
    ),
    "forecast-members-for-errors": (
        "--forecast errors --forecast-members 3", ("--forecast-members", "of ensemble", "is errors")
    ),
    "forecast-skill-for-file": (
        "--forecast a.csv --forecast-skill real",
        ("--forecast-skill", "errors and ensemble", "a.csv"),
    ),
    "forecast-skill-unknown": (
        "--forecast errors --forecast-skill large", ("--forecast-skill", "real, worse", "large")
    ),
    "forecast-skill-absent": (
        "--forecast errors --forecast-skill absent.yaml", ("absent.yaml", "cannot be read")
    ),
    "forecast-seed-broken": (
        "--forecast errors --forecast-seed 1.5", ("--forecast-seed", "whole number from 0")
    ),
    "forecast-members-none": (
        "--forecast ensemble --forecast-members 0", ("--forecast-members", "1 to 100")
    ),
    "roof-noise": ("--roof-noise -0.001", ("--roof-noise: must be a number from 0 to 1",)),
    "noise-seed": (
        "--noise-seed 0.5", ("--noise-seed: must be a whole number from 0 to 2147483647",)
    ),
    "minimum-off": ("--minimum-off 1e9", ("--minimum-off: must be a number from 0 to 86400",)),
    "output-is-a-file": ("--output file.txt", ("--output", "file.txt")),
}
# What else is refused of them, test_site.py and test_weather.py have.
SITES: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "unknown-key": ((SITE + "\na3: 1.0\n").encode(), ("a3", "not a parameter")),
    "binary": (bytes(range(256)), ("UTF-8",)),
}
WEATHERS: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "byte-order-mark": (b"\xef\xbb\xbf" + WEATHER.encode(), ("byte order mark",)),
    "no-evapotranspiration": (
        weather(*(line.rpartition(",")[0] for line in HOURS), header="time,precipitation [mm/h]"),
        ("evapotranspiration [mm/day]", "temperature, dew point"),
    ),
    "quote-open": (weather(HOURS[0], '2021-07-07T01:00-05:00,0.0,"2.7'), ("line 3", "CSV")),
    "far-future": (weather("9999-12-31T23:00-05:00,0.0,2.0"), ("line 2", "9999", "2037")),
    "shorter-than-the-run": (weather(*HOURS), ("2021-07-07T08:00-05:00", "12 hours")),
}
FORECAST_HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day]"
MEMBERS = "issued,time,member,precipitation [mm/h]"
ISSUED = "2021-07-07T00:00-05:00"


def forecasts(*lines: str, header: str = FORECAST_HEADER, issued: str = ISSUED) -> bytes:
    """Return a file of forecasts; a line begins with its time."""
    return "\n".join([header, *(f"{issued},{line}" for line in lines), ""]).encode()


FORECASTS: dict[str, tuple[bytes, tuple[str, ...]]] = {
    "empty": (b"", ("empty",)),
    "header-only": (forecasts(), ("no records",)),
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
    "cell-missing": (forecasts(HOURS[0], HOURS[1][:-4]), ("line 3", "4 cells", "not 3")),
    "quote-open": (forecasts(HOURS[0], '2021-07-07T01:00-05:00,0.0,"2'), ("line 3", "CSV")),
    "no-number": (
        forecasts(HOURS[0], HOUR.format(1, "M")), ("line 3", "precipitation [mm/h] = 'M'", "500")
    ),
    "negative": (forecasts(HOUR.format(0, -0.1)), ("line 2", "'-0.1'", "0 to 500 mm/h")),
    "nan": (forecasts(HOUR.format(0, "nan")), ("line 2", "'nan'")),
    "absurd-rain": (forecasts(HOUR.format(0, 501)), ("line 2", "'501'", "0 to 500 mm/h")),
    "absurd-evapotranspiration": (
        forecasts(HOURS[0].replace("2.0", "51")),
        ("line 2", "evapotranspiration [mm/day] = '51'", "0 to 50 mm/day"),
    ),
    "gap": (forecasts(HOURS[0], HOURS[2]), ("line 3", "time =", "must be 2021-07-07T01:00-05:00")),
    "late-first": (forecasts(HOURS[1]), ("line 2", "must be 2021-07-07T00:00-05:00")),
    "no-offset": (forecasts(HOURS[0].replace("-05:00", "")), ("line 2", "time =", "offset")),
    "issued-no-time": (forecasts(HOURS[0], issued="noon"), ("line 2", "issued = 'noon'")),
    "unsorted-issues": (
        forecasts(HOURS[0]) + forecasts(HOURS[0], issued="2021-07-06T23:00-05:00", header="#"),
        ("line 4", "issued = '2021-07-06T23:00-05:00'", "order of time"),
    ),
    "half-hour": (
        forecasts("2021-07-07T00:30-05:00,0.0,2.0", issued="2021-07-07T00:30-05:00"),
        ("line 2", "issued = '2021-07-07T00:30-05:00'", "whole number of hours from"),
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
    "run-before-the-first-issue": (
        forecasts("2021-07-07T03:00-05:00,0.0,2.0", issued="2021-07-07T03:00-05:00"),
        ("from 2021-07-07T03:00-05:00 on", "2021-07-07T02:00-05:00"),
    ),
}
CASES = [
    *((f"option-{name}", case[0], None, case[1]) for name, case in OPTIONS.items()),
    *((f"site-{name}", "--site FILE", *case) for name, case in SITES.items()),
    *((f"weather-{name}", "--weather FILE", *case) for name, case in WEATHERS.items()),
    *((f"forecast-{name}", "--forecast FILE.csv", *case) for name, case in FORECASTS.items()),
]


@pytest.mark.parametrize(
    ("options", "content", "words"), [case[1:] for case in CASES], ids=[case[0] for case in CASES]
)
def test_refused(
    unused_domain: int,
    tmp_path: Path,
    options: str,
    content: bytes | None,
    words: tuple[str, ...],
) -> None:
    """Both commands say what is wrong, where, and what would be right."""
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "something").touch()
    (tmp_path / "file.txt").touch()
    if content is not None:
        (tmp_path / options.split()[-1]).write_bytes(content)
    before = sorted(tmp_path.rglob("*"))
    for command in ("simulate", "bringup"):
        done = run_command(command, *options.split(), cwd=tmp_path, env=environment(unused_domain))
        assert done.returncode == 2, done.stderr
        assert done.stdout == ""
        assert done.stderr.count("error:") == 1, done.stderr
        assert "Traceback" not in done.stderr
        message = done.stderr.partition("error:")[2]
        for word in words:
            assert word in message
        if content is not None:
            assert "FILE" in message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("wrong", ["abc", "300", "-1"])
def test_wrong_domain(tmp_path: Path, wrong: str) -> None:
    """ROS_DOMAIN_ID is an input, too."""
    done = run_command(
        "bringup", "--hours", "0.01",
        cwd=tmp_path, env={**environment(0), "ROS_DOMAIN_ID": wrong},
    )
    assert done.returncode == 2
    assert f"ROS_DOMAIN_ID = '{wrong}'" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_wrong_output_leaves_no_trajectory(unused_domain: int, tmp_path: Path) -> None:
    """What is refused writes nothing, so that the repaired command can be given again."""
    done = run_command(
        "simulate", "--hours", "0.01", "--trajectory", "run.csv", "--output", "/proc/greenroof",
        cwd=tmp_path, env=environment(unused_domain),
    )
    assert done.returncode == 2
    assert not list(tmp_path.iterdir())


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
