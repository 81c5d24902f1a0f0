"""What a report refuses: one line that says what is wrong and where, before any writing."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from graphs import environment
from inputs import command, report_of, simulate, small_bag, write_bag, write_study
from places import CONFIG

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.report.pump_figures import read_pump_data
from greenroof_ros.report.runs import find_runs


def bag(how: Callable[[Path], Any] = lambda bag: None, **changes: Any) -> Callable[[Path], Any]:
    """Write a bag with other values, or with other files."""
    return lambda at: how(small_bag(at / "in", **changes))


def study(change: Callable[[str], str] = lambda text: text + "\n") -> Callable[[Path], Any]:
    """Write a study with a changed table."""

    def make(at: Path) -> None:
        example = simulate("onoff", "0.5", "low-low", "0.01")
        write_study(at / "in", [(example.row, example.trajectory)])
        file = at / "in" / "results.csv"
        text = file.read_text()
        assert change(text) != text
        file.write_text(change(text))

    return make


WRONG: dict[str, tuple[Callable[[Path], Any], tuple[str, ...]]] = {
    # name: what makes the input "in", words of the message
    "nothing-there": (lambda at: None, ("in: does not exist",)),
    "a-file": (lambda at: (at / "in").write_text("x"), ("in: must be a directory",)),
    "an-empty-directory": (lambda at: (at / "in").mkdir(), ("results.csv", "metadata.yaml")),
    "mcap-cut": (
        bag(lambda bag: os.truncate(bag / "in.mcap", 300)),
        ("cannot be read as a bag", "greenroof recover"),
    ),
    "foreign-topics": (
        lambda at: write_bag(at / "in", {"/scan/range": ([0, 1], [0.5, 0.6])}),
        ("/cistern/level", "/pump/flow", "its topics are: /scan/range"),
    ),
    "a-silent-topic": (bag(pump_flow=[]), ("no message of /pump/flow",)),
    "one-sample": (
        bag(roof_level=[0.03], cistern_level=[2.0], pump_command=[0.1], pump_flow=[0.001]),
        ("two samples", "not 1"),
    ),
    "float32": (
        lambda at: write_bag(
            at / "in",
            {name: ([0, 1], [0.0, 0.0])
             for name in ("/cistern/level", "/roof/level", "/pump/command", "/pump/flow")},
            msgtype="std_msgs/msg/Float32",
        ),
        ("std_msgs/msg/Float64", "not std_msgs/msg/Float32"),
    ),
    "not-a-number": (bag(roof_level=[0.03, float("nan"), 0.03]), ("/roof/level", "nan")),
    "study-without-results": (
        lambda at: (at / "in" / "runs" / "001").mkdir(parents=True),
        ("a study without results.csv",),
    ),
    "results-header-only": (
        study(lambda text: text.splitlines()[0] + "\n"), ("results.csv", "no runs")
    ),
    "results-of-something-else": (
        study(lambda text: "a,b\n1,2\n"), ("results.csv, line 1", "no column run, site")
    ),
    "no-finished-run": (
        study(lambda text: text.replace(",done,", ",failed,")),
        ("no finished run; 1 failed or did not run",),
    ),
    "row-cut": (
        study(lambda text: text[: text.index("\n") + 60]),
        ("results.csv, line 2", "ends in the middle of a line", "copy it again"),
    ),
    "row-too-short": (
        study(lambda text: text[: text.index("\n") + 60] + "\n"), ("line 2", "must have", "cells")
    ),
    "row-too-long": (study(lambda text: text[:-1] + ",1\n"), ("results.csv", "more fields")),
    "after-an-error-of-two-lines": (
        study(
            lambda text: text.replace(",done,,", ',done,"a\nb",')
            + text.splitlines()[1].replace(",done,", ",lost,") + "\n"
        ),
        ("results.csv, line 4", "status = 'lost'"),
    ),
    "status-unknown": (
        study(lambda text: text.replace(",done,", ",lost,")),
        ("line 2", "status = 'lost'", "done, failed or not run"),
    ),
    "volume-a-word": (
        study(lambda text: text.replace(",57.69", ",much57.69")),
        ("line 2", "cistern_m3", "much57.69"),
    ),
    "run-outside": (
        study(lambda text: text.replace("\n001,", "\n../001,")), ("line 2", "run = '../001'")
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_input(tmp_path: Path, name: str) -> None:
    """One line, and nothing is written."""
    prepare, words = WRONG[name]
    prepare(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ConfigurationError) as refused:
        report_of(tmp_path / "in")
    assert "\n" not in str(refused.value)
    for word in words:
        assert word in str(refused.value)
    assert sorted(tmp_path.rglob("*")) == before


def test_sites(tmp_path: Path) -> None:
    """A wrong site, and a site for a study."""
    (tmp_path / "site.yaml").write_text("a1: -25\n")
    with pytest.raises(ConfigurationError, match=r"site.yaml.*a1"):
        find_runs([small_bag(tmp_path / "bag")], tmp_path / "site.yaml")
    study()(tmp_path)
    with pytest.raises(ConfigurationError, match=r"--site.*has its own sites"):
        find_runs([tmp_path / "in"], CONFIG / "site.yaml")


def test_pump_data(tmp_path: Path) -> None:
    """A header and a line that do not hold flows and heads."""
    sheet = tmp_path / "p.csv"
    for text, line, words in (
        ("q,h\n0,50\n", 1, "'flow [m3/s],head [m]'"),
        ("flow [m3/s],head [m]\n0,50\n0.1,x\n", 3, "head [m] = 'x': must be a number from 0 to"),
        ("flow [m3/s],head [m]\n0,50\n4,46\n", 3, "flow [m3/s] = '4'"),
    ):
        sheet.write_text(text)
        with pytest.raises(ConfigurationError, match=f"p.csv, line {line}: ") as refused:
            read_pump_data(sheet)
        assert words in str(refused.value)


COMMANDS = {
    "": "in: has no metadata.yaml: it is being recorded, or was cut off; greenroof recover in",
    "--pump-data nowhere.csv": "nowhere.csv: cannot be read: No such file",
    "--output mine": "--output = 'mine': exists and is not empty: x does not belong to a repor",
}


@pytest.mark.parametrize("options", COMMANDS)
def test_command(tmp_path: Path, options: str) -> None:
    """Exit code 2, one line, no traceback, nothing written."""
    small_bag(tmp_path / "in")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "x").touch()
    if not options:
        (tmp_path / "in" / "metadata.yaml").unlink()
    before = sorted(tmp_path.rglob("*"))
    done = command("in", *options.split(), cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr and done.stdout == ""
    message = done.stderr.partition("error:")[2].strip()
    assert COMMANDS[options] in message and "\n" not in message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("missing", ["altair", "rosbags"])
def test_without_the_extra(tmp_path: Path, missing: str) -> None:
    """Without the extra the error says what to install."""
    small_bag(tmp_path / "in")
    code = (
        f"import sys, runpy; sys.modules[{missing!r}] = None; "
        "sys.argv = ['report', 'in', '--output', 'report']; "
        "runpy.run_module('greenroof_ros.report', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={**os.environ, **environment(0)},
        capture_output=True, text=True, timeout=60, check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "install greenroof_ros with its extra [study]" in done.stderr
    assert "Traceback" not in done.stderr
