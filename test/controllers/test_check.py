"""check_controller: this package's controllers and the example pass, broken ones fail."""

from __future__ import annotations

import os
import sys
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
    """Return a replacement in the example's code that makes its command go wrong."""
    return RETURNS, f"command = min(command, 1.0) if command > 0 else 0.0; {code}"


def planning(plan: str) -> tuple[str, str]:
    """Return a replacement that gives it an invalid plan."""
    outputs = f'    outputs = {{"/controller/plan": "plan"}}\n    import numpy\n    plan = {plan}\n'
    return HEAD, outputs + HEAD


FINITE = "its commands are finite and not negative, at all levels and for all forecasts"
OUTPUTS = "each of its outputs is a topic of the interface and has a value after a command"
NO_PLAN = "the attribute plan must be a numpy array of floats of shape (n, 4)"
VALVE = (
    "if it commands the outlet valve itself, its attribute outlet is between 0 and 1 in every tick"
)


def opening(share: str) -> tuple[str, str]:
    """Return a replacement with which it commands the valve itself."""
    return HEAD, f"    @property\n    def outlet(self):\n        return {share}\n\n{HEAD}"


BROKEN = [
    # The error, the rule that it breaks, and the message.
    (returning("return -command if command else 0.0"), FINITE, "must be a finite number of at le"),
    (
        returning("return command if self.gain else -1.0"),
        "its commands are also valid with each parameter at either end of its range",
        "with gain = 0, command() ret",
    ),
    (
        returning("import random; return command * random.random()"),
        "two instances give the same commands for the same inputs", "for the same inputs",
    ),
    (
        returning("evapotranspiration[0] = 1.0; return command"),
        "it does not modify the forecasts passed to it", "copy them first",
    ),
    (
        returning("precipitation[3]; return command"),
        "a missing or invalid forecast leads only to a valid command or a ConfigurationError",
        "raises IndexError",
    ),
    (
        (
            "def statistics(self) -> None:\n",
            'def statistics(self):\n        return {"solves": 1}\n',
        ),
        "statistics() returns None, or the statistics of its solver",
        "statistics() must return None, or a value for each of fallbacks, max_s, mean_s, p99_s, "
        "solves",
    ),
    # The node can only send an array of floats with the interface's columns as plan.
    (planning("numpy.zeros((2, 4), dtype=int)"), OUTPUTS, NO_PLAN),
    *((opening(share), VALVE, f"Proportional = {value}: must be a number from 0 to 1")
      for share, value in {
          "1.2": "1.2", "-0.1": "-0.1", "float('nan')": "nan", "None": "None", "True": "True",
          "'open'": "'open'", "[0.5]": "[0.5]", "10**5000": "a number with thousands of digits",
      }.items()),
    (opening("{}[0]"), VALVE, "Proportional.outlet: raises KeyError: 0"),
    (
        opening("self.__dict__.setdefault('shares', [1.0, 0.5]).pop()"), VALVE,
        "Proportional.outlet: raises IndexError: pop from empty list",
    ),
    (opening("__import__('random').random()"), VALVE, "for the same inputs"),
    (
        opening("self.gain / 20"),
        "its commands are also valid with each parameter at either end of its range",
        "with gain = 10000, ",
    ),
    (("self.gain = gain", "self.gain = gain; self.outlet = 0.0"), VALVE, "define it in the class"),
]


@pytest.mark.parametrize("name", [*BUILT_IN, EXAMPLE, "examples.rain_wait:RainWait"])
def test_controllers_that_keep_to_it(name: str) -> None:
    """All checks pass."""
    results = check_controller(find_controller(name), PAPER_SITE)
    assert len(results) >= 10
    assert not any(results.values())


def check_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: tuple[str, str]
) -> dict[str, str]:
    """Check the example with a change, and return the problems by what is checked."""
    assert TEXT.count(change[0]) == 1
    (tmp_path / "changed.py").write_text(TEXT.replace(*change))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "changed", raising=False)
    return check_controller(find_controller("changed:Proportional"), PAPER_SITE)


@pytest.mark.parametrize(("change", "rule", "problem"), BROKEN)
def test_broken_controllers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: tuple[str, str], rule: str,
    problem: str,
) -> None:
    """Each fails for its own reason."""
    assert problem in check_changed(tmp_path, monkeypatch, change)[rule]


@pytest.mark.parametrize("share", ["0.5", "__import__('numpy').float32(1)", "0", "1", "-0.0"])
def test_shares_of_the_valve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: str
) -> None:
    assert not any(check_changed(tmp_path, monkeypatch, opening(share)).values())


def test_the_command(tmp_path: Path) -> None:
    """Exit code 0 if all is right, 1 if something is wrong, 2 if it cannot be imported."""
    (tmp_path / "broken.py").write_text(TEXT.replace(*returning("return None")))
    for reference, directory, code, message in (
        (EXAMPLE, CHECKOUT, 0, "13 of 13 checks passed"),
        ("broken:Proportional", tmp_path, 1, "must be a finite"),
        ("nothing:Here", tmp_path, 2, ""),
    ):
        result = run_command(
            "check_controller", reference, cwd=directory, env={**os.environ}
        )
        assert result.returncode == code, result.stderr
        assert message in result.stdout and "Traceback" not in result.stderr
