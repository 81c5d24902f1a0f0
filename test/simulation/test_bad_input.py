"""Wrong options and files: exit code 2, one clear message, no traceback, nothing started."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.commands.simulate import main
from greenroof_ros.forecast.issue import read_forecasts

HEADER = "issued,time,precipitation [mm/h],evapotranspiration [mm/day]"
MEMBERS = "issued,time,member,precipitation [mm/h]"
# Starts of hours.
H0, H1, H2, H3 = (f"2021-07-07T0{hour}:00-05:00" for hour in range(4))
# Options and their errors: one case for each rule. Wrong files are in test_site.py, test_reading.py
# and FORECASTS.
OPTIONS = {
    "--controller external": "controller = 'external': is a node that you run",
    "--controller onoff --weight 0.1": "--weight 0.1 (the parameters of onoff are --fraction",
    "--cistern 60": "--roof: is missing; set both cistern and roof",
    "--initial low-low --cistern 60 --roof 2": "--initial",
    "--hours 0.0001": "whole number of ticks",
    "--start 2021-07-06T23:00-05:00": "2021-07-07T00:00-05:00",
    "--output full": "never overwrites",
    "--forecast late.csv": "before 2021-07-07T03:00-05:00",
    "--forecast-seed 1": "errors and ensemble",
}
# The lines of a forecast file, the number of the wrong line, and the key.
FORECASTS = [
    ([HEADER.replace("mm/day", "mm/h"), f"{H0},{H0},0,2"], 1,
     "evapotranspiration [mm/h]"),
    ([HEADER, f"{H0},{H0},0,2", f"{H0},{H2},0,2"], 3, "time"),
    ([MEMBERS, f"{H0},{H0},-1,0"], 2, "member"),
    ([MEMBERS, f"{H0},{H0},0,0", f"{H0},{H0},2,0"], 2, "member"),
]


@pytest.mark.parametrize("options", OPTIONS)
def test_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    options: str,
) -> None:
    """The error states what is wrong, where, and what would be right; no files are left."""
    (tmp_path / "full" / "something").mkdir(parents=True)
    (tmp_path / "late.csv").write_text(f"{HEADER}\n{H3},{H3},0.0,2.0\n")
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["simulate", *options.split()])
    with pytest.raises(SystemExit) as ended:
        main()
    output = capsys.readouterr()
    assert (ended.value.code, output.out) == (2, "")
    assert output.err.count("error:") == 1, output.err
    assert OPTIONS[options] in output.err.partition("error:")[2]
    assert sorted(tmp_path.rglob("*")) == before


def test_the_environment_is_input_too(tmp_path: Path) -> None:
    """No files are left."""
    given = {**environment(0), "ROS_DOMAIN_ID": "300"}
    done = run_command("bringup", "--hours", "0.01", cwd=tmp_path, env=given)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("error:") == 1, done.stderr
    assert "ROS_DOMAIN_ID = '300'" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("lines", "line", "key"), FORECASTS)
def test_refused_forecasts(tmp_path: Path, lines: list[str], line: int, key: str) -> None:
    """Rules that only forecast files have; test_records.py has the rules of all CSV."""
    file = tmp_path / "FILE.csv"
    file.write_text("\n".join([*lines, ""]))
    with pytest.raises(ConfigurationError) as refused:
        read_forecasts(file)
    assert str(refused.value).startswith(f"{file}, line {line}: ")
    assert key in (refused.value.key, refused.value.value)
