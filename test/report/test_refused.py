"""What a report refuses: one line that says what is wrong and where, before anything is written."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import environment
from inputs import TOPICS, simulate, small_bag, write_bag, write_study
from places import CONFIG


def cut(file: Path, keep: int) -> None:
    file.write_bytes(file.read_bytes()[:keep])


def broken_bag(how: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda at: how(small_bag(at / "in"))


def bag(**changes: Any) -> Callable[[Path], Any]:
    return lambda at: small_bag(at / "in", **changes)


def study(change: Callable[[str], str] = lambda text: text + "\n") -> Callable[[Path], Any]:
    """A study whose table is changed."""

    def make(at: Path) -> None:
        one = simulate("onoff", "0.5", "low-low", "0.01")
        write_study(at / "in", [(one.row, one.trajectory)])
        file = at / "in" / "results.csv"
        text = file.read_text()
        assert change(text) != text
        file.write_text(change(text))

    return make


def pump_data(text: str) -> Callable[[Path], Any]:
    return lambda at: (small_bag(at / "in"), (at / "p.csv").write_text(text))


def cut_trajectory(at: Path) -> None:
    study()(at)
    cut(at / "in" / "runs" / "001" / "trajectory.parquet", 1000)


WRONG: dict[str, tuple[Callable[[Path], Any], str, tuple[str, ...]]] = {
    # name: what makes the input "in", further options, words of the message
    "nothing-there": (lambda at: None, "", ("in: does not exist",)),
    "a-file": (lambda at: (at / "in").write_text("x"), "", ("in: must be a directory",)),
    "an-empty-directory": (lambda at: (at / "in").mkdir(), "", ("results.csv", "metadata.yaml")),
    "no-metadata": (
        broken_bag(lambda bag: (bag / "metadata.yaml").unlink()), "",
        ("no metadata.yaml", "greenroof recover in"),
    ),
    "metadata-binary": (
        broken_bag(lambda bag: (bag / "metadata.yaml").write_bytes(b"\x80\xff")),
        "", ("cannot be read as a bag",),
    ),
    "mcap-cut": (
        broken_bag(lambda bag: cut(bag / "in.mcap", 300)), "",
        ("cannot be read as a bag", "greenroof recover in"),
    ),
    "mcap-gone": (
        broken_bag(lambda bag: (bag / "in.mcap").unlink()), "", ("cannot be read as a bag",)
    ),
    "foreign-topics": (
        lambda at: write_bag(at / "in", {"/scan/range": ([0, 1], [0.5, 0.6])}), "",
        ("/cistern/level", "/pump/flow", "its topics are: /scan/range"),
    ),
    "one-topic-missing": (bag(pump_flow=None), "", ("has no /pump/flow",)),
    "a-silent-topic": (bag(pump_flow=[]), "", ("no message of /pump/flow",)),
    "one-sample": (
        bag(roof_level=[0.03], cistern_level=[2.0], pump_command=[0.1], pump_flow=[0.001]),
        "", ("two samples", "not 1"),
    ),
    "float32": (
        lambda at: write_bag(
            at / "in", {name: ([0, 1], [0.0, 0.0]) for name in list(TOPICS)[:4]},
            msgtype="std_msgs/msg/Float32",
        ),
        "", ("std_msgs/msg/Float64", "not std_msgs/msg/Float32"),
    ),
    "a-wrong-unit": (
        bag(cistern_level=[2000.0] * 3), "", ("/cistern/level", "2000", "0 to 9 m", "outlet")
    ),
    "not-a-number": (bag(roof_level=[0.03, float("nan"), 0.03]), "", ("/roof/level", "nan")),
    "infinite": (bag(pump_command=[0.1, float("inf"), 0.1]), "", ("/pump/command", "inf")),
    "negative": (bag(pump_command=[0.1, -0.1, 0.1]), "", ("/pump/command",)),
    "given-twice": (bag(), "in", ("two runs are named in",)),
    "site-wrong": (
        lambda at: (small_bag(at / "in"), (at / "site.yaml").write_text("a1: -25\n")),
        "--site site.yaml", ("site.yaml", "a1"),
    ),
    "site-for-a-study": (
        study(), f"--site {CONFIG / 'site.yaml'}", ("--site", "has its own sites")
    ),
    "output-not-empty": (
        lambda at: (small_bag(at / "in"), (at / "report").mkdir(), (at / "report/x").touch()), "",
        ("--output", "not empty", "never written over"),
    ),
    "output-a-file": (
        lambda at: (small_bag(at / "in"), (at / "report").touch()), "", ("--output", "report")
    ),
    "study-without-results": (
        lambda at: (at / "in" / "runs" / "001").mkdir(parents=True), "",
        ("a study without results.csv",),
    ),
    "results-empty": (study(lambda text: ""), "", ("results.csv", "is empty")),
    "results-header-only": (
        study(lambda text: text.splitlines()[0] + "\n"), "", ("results.csv", "no runs")
    ),
    "results-of-something-else": (
        study(lambda text: "a,b\n1,2\n"), "", ("results.csv, line 1", "no column run, site")
    ),
    "no-finished-run": (
        study(lambda text: text.replace(",done,", ",failed,")), "",
        ("no finished run; 1 failed or did not run",),
    ),
    "row-cut": (
        study(lambda text: text[: text.index("\n") + 60]), "", ("results.csv, line 2", "cells")
    ),
    "status-unknown": (
        study(lambda text: text.replace(",done,", ",lost,")), "",
        ("line 2", "status = 'lost'", "done, failed or not run"),
    ),
    "volume-a-word": (
        study(lambda text: text.replace(",57.69", ",much57.69")), "",
        ("line 2", "cistern_m3", "much57.69"),
    ),
    "run-outside": (
        study(lambda text: text.replace("\n001,", "\n../001,")), "", ("line 2", "run = '../001'")
    ),
    "site-of-the-study-gone": (
        study(lambda text: text.replace(",site.yaml,", ",other.yaml,")), "",
        ("other.yaml", "No such file"),
    ),
    "trajectory-cut": (cut_trajectory, "", ("001/trajectory.parquet", "cut short")),
    "no-pump-data": (bag(), "--pump-data nowhere.csv", ("nowhere.csv", "No such file")),
    "pump-data-header": (
        pump_data("q,h\n0,50\n"), "--pump-data p.csv", ("p.csv, line 1", "flow [m3/s],head [m]")
    ),
    "pump-data-word": (
        pump_data("flow [m3/s],head [m]\n0,50\n1,x\n"), "--pump-data p.csv",
        ("p.csv, line 3", "1,x"),
    ),
    "pump-data-swapped": (
        pump_data("flow [m3/s],head [m]\n0,1\n0.1,2\n"), "--pump-data p.csv", ("p.csv", "must fall")
    ),
    "price-negative": (bag(), "--water-price=-1", ("--water-price",)),
    "band-a-word": (bag(), "--band wide", ("--band", "wide")),
}


@pytest.mark.parametrize("name", WRONG)
def test_refused(tmp_path: Path, name: str) -> None:
    """Exit code 2, one line, no traceback, nothing written."""
    prepare, options, words = WRONG[name]
    prepare(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    arguments = ("report", "in", *options.split(), "--output", "report")
    done = run_command(*arguments, cwd=tmp_path, env=environment(0))
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr and done.stdout == ""
    assert done.stderr.count("error:") == 1, done.stderr
    message = done.stderr.partition("error:")[2].strip()
    assert "\n" not in message
    for word in words:
        assert word in message
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("missing", ["altair", "vl_convert", "jinja2", "polars", "rosbags"])
def test_without_the_extra(tmp_path: Path, missing: str) -> None:
    """A plain installation says what to install."""
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
    assert "pip install 'greenroof_ros[study]'" in done.stderr
    assert "Traceback" not in done.stderr
