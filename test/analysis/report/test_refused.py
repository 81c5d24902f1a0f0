"""What a report refuses: one line that reports what is wrong and where, before any writing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from graphs import environment
from inputs import report_of, small_bag, write_bag, write_study
from places import refusal

NEEDED = ("cistern_level", "roof_level", "pump_command", "pump_flow")


def another_table(at: Path) -> None:
    """Write a study whose table has another column."""
    columns = ("site", "start", "initial", "status", "error", "window", "case", "of")
    write_study(at, [(dict.fromkeys(columns, "any"), None)])


# name: what makes the input "in", the message as a pattern
WRONG: dict[str, tuple[Callable[[Path], Any], str]] = {
    "nothing-there": (lambda at: None, "in: must be the directory of a study"),
    "being-recorded": (
        lambda at: (small_bag(at) / "metadata.yaml").unlink(),
        r"in: cannot be read as a bag.*[^.]\. If it is damaged, greenroof recover .*/in makes",
    ),
    "foreign-topics": (
        lambda at: write_bag(at, {"/scan": ([0, 1], [0.5, 0.6])}),
        "lacks .*/cistern/level.*/pump/flow.*: /scan",
    ),
    "float32": (
        lambda at: write_bag(at, {
            f"/{name.replace('_', '/')}": ([0, 1], [0.5, 0.6]) for name in NEEDED
        }, msgtype="std_msgs/msg/Float32"), "not std_msgs/msg/Float32",
    ),
    "another-table": (another_table, "results.csv: is not the table .*season"),
}


@pytest.mark.parametrize("name", WRONG)
def test_input(tmp_path: Path, name: str) -> None:
    """One line, and nothing is written."""
    prepare, pattern = WRONG[name]
    prepare(tmp_path / "in")
    before = sorted(tmp_path.rglob("*"))
    assert "\n" not in refusal(report_of, tmp_path / "in", match=pattern)
    assert sorted(tmp_path.rglob("*")) == before


def test_without_the_extra(tmp_path: Path) -> None:
    """Without the extra the error states what to install."""
    small_bag(tmp_path / "in")
    code = (
        "import sys; sys.modules['altair'] = None; sys.argv[1:] = ['in'];"
        "from greenroof_ros.commands.report import main; sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment(0), capture_output=True,
        text=True, timeout=300, check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "install greenroof_ros with its extra [study]" in done.stderr
    assert "Traceback" not in done.stderr
