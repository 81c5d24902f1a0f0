"""check_controller: this package's controllers and the example pass, broken ones fail."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from commands import run_command
from paper import PAPER_SITE
from places import CHECKOUT

from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller

EXAMPLE = "examples.proportional:Proportional"
TEXT = (CHECKOUT / "examples" / "proportional.py").read_text()
RETURNS = "return min(command, 1.0) if command > 0 else 0.0"
HEAD = "    parameters = (\n"


def returning(code: str) -> tuple[str, str]:
    """Return what of the example's code is replaced to make it go wrong in the end."""
    return RETURNS, f"command = min(command, 1.0) if command > 0 else 0.0; {code}"


def planning(plan: str) -> tuple[str, str]:
    """Do the same for one whose plan is no plan."""
    own = f'    outputs = {{"/controller/plan": "plan"}}\n    import numpy\n    plan = {plan}\n'
    return HEAD, own + HEAD


FINITE = "its commands are finite and not negative, at all levels and forecasts"
OUTPUTS = "each of its outputs is a topic of the interface and has its value after a command"
NO_PLAN = "no numpy array of floats, of shape (n, 3), in the attribute plan"
BROKEN = [
    # What it does wrong, the rule that it breaks, and what is said of it.
    (returning("return -command if command else 0.0"), FINITE, "must be finite and not negative"),
    (returning("return None"), FINITE, "command() returns None; it must return a float"),
    (
        returning("import random; return command * random.random()"),
        "two of it give the same commands to the same inputs", "on equal inputs",
    ),
    (
        returning("evapotranspiration[0] = 1.0; return command"),
        "it leaves the forecasts that it gets as they are", "copy them first",
    ),
    (
        returning("precipitation[3]; return command"),
        "a missing or wrong forecast gives a valid command or a ConfigurationError, nothing else",
        "raises IndexError",
    ),
    (
        (HEAD, f'    outputs = {{"/pump/command": "gain"}}\n{HEAD}'), OUTPUTS,
        "outputs = '/pump/command': is no output of a controller",
    ),
    (
        (
            "def statistics(self) -> None:\n",
            'def statistics(self):\n        return {"solves": 1}\n',
        ),
        "its statistics are None, or the figures of its solver",
        "statistics() must be None or have fallbacks, max_s, mean_s, p99_s, solves",
    ),
    # The node can send no other plan than an array of floats with the interface's columns.
    (planning("[[10.0, 0.0, 0.04]]"), OUTPUTS, NO_PLAN),
    (planning("numpy.zeros((2, 3), dtype=int)"), OUTPUTS, NO_PLAN),
    (planning("numpy.zeros((2, 2))"), OUTPUTS, NO_PLAN),
]


@pytest.mark.parametrize("name", [*BUILT_IN, EXAMPLE])
def test_controllers_that_keep_to_it(name: str) -> None:
    """All checks pass."""
    findings = check_controller(find_controller(name), PAPER_SITE)
    assert len(findings) >= 10
    assert [finding for finding in findings if finding.problem] == []


def check(directory: Path, reference: str) -> subprocess.CompletedProcess[str]:
    """Run the command in a directory."""
    return run_command(
        "check_controller", reference, cwd=directory, env={**os.environ, "COLUMNS": "250"}
    )


@pytest.mark.parametrize(("change", "rule", "problem"), BROKEN)
def test_broken_controllers(
    tmp_path: Path, change: tuple[str, str], rule: str, problem: str
) -> None:
    """Each fails for its own reason, by the real command."""
    assert TEXT.count(change[0]) == 1
    (tmp_path / "broken.py").write_text(TEXT.replace(*change))
    result = check(tmp_path, "broken:Proportional")
    assert result.returncode == 1, result.stderr
    row = next(line for line in result.stdout.splitlines() if f" {rule} " in line)
    assert problem in row
    assert "Traceback" not in result.stderr


def test_the_command(tmp_path: Path) -> None:
    """The example passes all, exit code 0; what cannot be imported is refused with 2."""
    result = check(CHECKOUT, EXAMPLE)
    assert result.returncode == 0
    assert "12 of 12 checks passed" in result.stdout
    assert check(tmp_path, "nothing:Here").returncode == 2
