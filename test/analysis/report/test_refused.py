"""What a report refuses: one line that reports what is wrong and where, before any writing."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from graphs import environment
from inputs import command, report_of, simulate, small_bag, write_bag, write_study
from places import CONFIG
from refusals import refusal

from greenroof_ros.analysis.report.sources import find_runs


def bag(**changes: Any) -> Callable[[Path], Any]:
    """Return what writes a bag with other values."""
    return lambda at: small_bag(at, **changes)


def topics(*names: str, **options: str) -> Callable[[Path], Any]:
    """Return what writes a bag with these topics."""
    return lambda at: write_bag(at, dict.fromkeys(names, ([0, 1], [0.5, 0.6])), **options)


def study(change: Callable[[str], str]) -> Callable[[Path], Any]:
    """Return what writes a study with a changed table."""

    def make(at: Path) -> None:
        example = simulate("onoff", "0.5", "low-low", "0.01")
        file = write_study(at, [(example.row, example.trajectory)]) / "results.csv"
        text = file.read_text()
        assert change(text) != text
        file.write_text(change(text))

    return make


def replaced(old: str, new: str) -> Callable[[Path], Any]:
    """Return what writes a study with another text in its table."""
    return study(lambda text: text.replace(old, new))


def with_cells(**cells: object) -> Callable[[Path], Any]:
    """Return what writes a study whose only run has other values."""
    return lambda at: write_study(
        at, [({**simulate("onoff", "0.5", "low-low", "0.01").row, **cells}, None)]
    )


def unfinished_bag(at: Path) -> None:
    """Write a bag as it is while it is recorded."""
    (small_bag(at) / "metadata.yaml").unlink()


NEEDED = ("cistern_level", "roof_level", "pump_command", "pump_flow")
# name: what makes the input "in", the message as a pattern
WRONG: dict[str, tuple[Callable[[Path], Any], str]] = {
    "nothing-there": (lambda at: None, "in: does not exist"),
    "an-empty-directory": (Path.mkdir, "results.csv.*metadata.yaml"),
    "unfinished": (unfinished_bag, "in: has no metadata.yaml: .*greenroof recover"),
    "foreign-topics": (
        topics("/scan"), "lacks .*/cistern/level.*/pump/flow.*topics in the bag are: /scan",
    ),
    "one-sample": (bag(**{name: [0.01] for name in NEEDED}), "two samples.*not 1"),
    "float32": (
        topics(*(f"/{name.replace('_', '/')}" for name in NEEDED), msgtype="std_msgs/msg/Float32"),
        "of type std_msgs/msg/Float64, not std_msgs/msg/Float32",
    ),
    "another-table": (
        study(lambda text: text.replace(",season,", ",of,")),
        "results.csv, line 1: has no column season.* repeat the command greenroof study",
    ),
    "no-finished-run": (replaced(",done,", ",failed,"), "no finished run; 1 failed or did not run"),
    "row-too-short": (study(lambda text: text[:-20] + "\n"), "line 2: .*not a valid value"),
    "row-cut": (study(lambda text: text[:-2]), "results.csv, line 2: ends in the middle of a line"),
    "a-row-twice": (
        study(lambda text: text + text.splitlines()[1] + "\n"), "results.csv, line 3: run = '001'"
    ),
    "run-outside": (replaced("\n001,", "\n../001,"), "line 2: run = '../001': must be the name"),
    "status": (replaced(",done,", ",lost,"), "line 2: status = 'lost': must be done, failed or"),
    "no-total": (with_cells(total_deviation_m3=""), "total_deviation_m3: must not be empty"),
    "total-nan": (with_cells(total_deviation_m3="nan"), "total_deviation_m3 = 'nan': is not a"),
    "bound-below-0": (with_cells(bound_m3="-1"), "bound_m3 = '-1': is not a valid value"),
    "volume-a-word-after-an-error-of-two-lines": (
        study(
            lambda text: text.replace(",done,,", ',done,"a\nb",')
            + text.splitlines()[1].replace(",57.69", ",much57.69") + "\n"
        ),
        "results.csv, line 4: cistern_m3 = 'much57.69",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_input(tmp_path: Path, name: str) -> None:
    """One line, and nothing is written."""
    prepare, pattern = WRONG[name]
    prepare(tmp_path / "in")
    before = sorted(tmp_path.rglob("*"))
    assert "\n" not in refusal(report_of, tmp_path / "in", match=pattern)
    assert sorted(tmp_path.rglob("*")) == before


def test_sites(tmp_path: Path) -> None:
    """A wrong site, and a site for a study."""
    (tmp_path / "site.yaml").write_text("a1: -25\n")
    paths = [small_bag(tmp_path / "bag")]
    refusal(find_runs, paths, tmp_path / "site.yaml", match=r"site.yaml.*a1")
    paths = [write_study(tmp_path / "in", [])]
    refusal(find_runs, paths, CONFIG / "site.yaml", match="--site.*has its own sites")


def test_command(tmp_path: Path) -> None:
    """Exit code 2, one line, no traceback, nothing written."""
    small_bag(tmp_path / "in")
    (tmp_path / "mine" / "figures").mkdir(parents=True)
    (tmp_path / "mine" / "figures" / "mine.svg").touch()
    before = sorted(tmp_path.rglob("*"))
    done = command("in", "--output", "mine", cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr and done.stdout == ""
    message = done.stderr.partition("error:")[2].strip()
    assert "--output = 'mine': contains figures/mine.svg, which is not part of a" in message
    assert "\n" not in message
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
