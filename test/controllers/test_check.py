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
BROKEN = {
    # What it does wrong: the rule that it breaks, and what is said of it.
    "return -command if command else 0.0": (
        "its commands are finite and not negative, at all levels and forecasts",
        "it must be finite and not negative",
    ),
    "import random; return command * random.random()": (
        "two of it give the same commands to the same inputs", "on equal inputs",
    ),
    "evapotranspiration[0] = 1.0; return command": (
        "it leaves the forecasts that it gets as they are", "copy them first",
    ),
    "precipitation[3]; return command": (
        "a missing or wrong forecast gives a valid command or a ConfigurationError, nothing else",
        "raises IndexError",
    ),
    "return None": (
        "its commands are finite and not negative, at all levels and forecasts",
        "command() returns None; it must return a float",
    ),
}


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


@pytest.mark.parametrize("code", BROKEN)
def test_broken_controllers(tmp_path: Path, code: str) -> None:
    """Each fails for its own reason, by the real command."""
    text = (CHECKOUT / "examples" / "proportional.py").read_text()
    right = "return min(command, 1.0) if command > 0 else 0.0"
    assert right in text
    broken = text.replace(
        right, f"command = min(command, 1.0) if command > 0 else 0.0; {code}"
    )
    (tmp_path / "broken.py").write_text(broken)
    result = check(tmp_path, "broken:Proportional")
    assert result.returncode == 1, result.stderr
    rule, problem = BROKEN[code]
    row = next(line for line in result.stdout.splitlines() if f" {rule} " in line)
    assert problem in row
    assert "Traceback" not in result.stderr


def test_an_output_that_is_none_of_a_controller(tmp_path: Path) -> None:
    """/pump/command is a controller's topic, but no output beside the command."""
    text = (CHECKOUT / "examples" / "proportional.py").read_text()
    head = "    parameters = (\n"
    assert head in text
    (tmp_path / "broken.py").write_text(
        text.replace(head, f'    outputs = {{"/pump/command": "gain"}}\n{head}')
    )
    result = check(tmp_path, "broken:Proportional")
    assert result.returncode == 1, result.stderr
    assert "outputs = '/pump/command': is no output of a controller" in result.stdout


def test_plans_that_are_none(tmp_path: Path) -> None:
    """A plan is an array of floats with the interface's columns; the node can send no other."""
    text = (CHECKOUT / "examples" / "proportional.py").read_text()
    head = "    parameters = (\n"
    for name, plan in {
        "rows": "[[10.0, 0.0, 0.04]]", "whole": "numpy.zeros((2, 3), dtype=int)",
        "narrow": "numpy.zeros((2, 2))",
    }.items():
        own = f'    outputs = {{"/controller/plan": "plan"}}\n    plan = {plan}\n'
        module = text.replace(head, own + head).replace(
            "from greenroof_ros.model.site", "import numpy\nfrom greenroof_ros.model.site"
        )
        (tmp_path / f"{name}.py").write_text(module)
        result = check(tmp_path, f"{name}:Proportional")
        assert result.returncode == 1, result.stderr
        assert "no numpy array of floats, of shape (n, 3), in the attribute plan" in result.stdout


def test_the_command(tmp_path: Path) -> None:
    """The example passes all, exit code 0; what cannot be imported is refused with 2."""
    result = check(CHECKOUT, EXAMPLE)
    assert result.returncode == 0
    assert "12 of 12 checks passed" in result.stdout
    assert check(tmp_path, "nothing:Here").returncode == 2
