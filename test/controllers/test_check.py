"""check_controller: this package's controllers and the example pass, broken ones fail."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from checked_nodes import changed
from commands import run_command
from paper import PAPER_SITE
from places import CHECKOUT

from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller

EXAMPLE = "examples.proportional:Proportional"
TEXT = (CHECKOUT / "examples" / "proportional.py").read_text()
RETURNS = "return min(command, 1.0) if command > 0 else 0.0"
HEAD = "    parameters = (\n"
FINITE = "its commands are finite and not negative, at all levels and for all forecasts"
EITHER_END = "its commands are also valid with each parameter at either end of its range"
OUTPUTS = "each of its outputs is a topic of the interface and has a value after a command"
VALVE = (
    "if it commands the outlet valve itself, its attribute outlet is between 0 and 1 in every tick"
)


def returning(code: str) -> dict[str, str]:
    """Return a replacement in the example's code that makes its command go wrong."""
    return {RETURNS: f"command = min(command, 1.0) if command > 0 else 0.0; {code}"}


def opening(share: str) -> dict[str, str]:
    """Return a replacement with which it commands the valve itself."""
    return {HEAD: f"    @property\n    def outlet(self):\n        return {share}\n\n{HEAD}"}


@pytest.mark.parametrize("name", [*BUILT_IN, EXAMPLE, "examples.rain_wait:RainWait"])
def test_controllers_that_keep_to_it(name: str) -> None:
    """All checks pass."""
    results = check_controller(find_controller(name), PAPER_SITE)
    assert len(results) >= 10
    assert not any(results.values())


# The change, the rule that it breaks, and the message.
@pytest.mark.parametrize(("change", "rule", "problem"), [
    (returning("return -command if command else 0.0"), FINITE, "must be a finite number of at le"),
    (returning("return command if self.gain else -1.0"), EITHER_END, "with gain = 0, command() "),
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
        {"statistics(self) -> None:\n": 'statistics(self):\n        return {"solves": 1}\n'},
        "statistics() returns None, or the statistics of its solver",
        "statistics() must return None, or a value for each of fallbacks, max_s, mean_s, p99_s, ",
    ),
    (  # the node can only send an array of floats with the interface's columns
        {HEAD: '    outputs = {"/controller/plan": "plan"}\n    import numpy\n'
            f"    plan = numpy.zeros((2, 4), dtype=int)\n{HEAD}"},
        OUTPUTS, "the attribute plan must be a numpy array of floats of shape (n, 4)",
    ),
    (opening("1.2"), VALVE, "Proportional = 1.2: must be a number from 0 to 1"),
    (opening("float('nan')"), VALVE, "Proportional = nan: must be a number from 0 to 1"),
    (opening("None"), VALVE, "Proportional = None: must be a number from 0 to 1"),
    (opening("{}[0]"), VALVE, "Proportional.outlet: raises KeyError: 0"),
    (
        opening("self.__dict__.setdefault('shares', [1.0, 0.5]).pop()"), VALVE,
        "Proportional.outlet: raises IndexError: pop from empty list",
    ),
    (opening("__import__('random').random()"), VALVE, "for the same inputs"),
    (opening("self.gain / 20"), EITHER_END, "with gain = 10000, "),
    ({"self.gain = gain": "self.gain = gain; self.outlet = 0.0"}, VALVE, "define it in the class"),
    (opening("__import__('numpy').float32(1)"), "", ""),
    (opening("-0.0"), "", ""),
])
def test_changed_controllers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], rule: str,
    problem: str,
) -> None:
    """Each broken one fails for its own reason; without a rule, all is right."""
    ((old, new),) = change.items()
    (tmp_path / "changed.py").write_text(changed(TEXT, old, new))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "changed", raising=False)
    problems = check_controller(find_controller("changed:Proportional"), PAPER_SITE)
    assert problem in problems[rule] if rule else not any(problems.values())


def test_the_command(tmp_path: Path) -> None:
    """Exit code 0 if all is right, 1 if something is wrong, 2 if it cannot be imported."""
    (tmp_path / "broken.py").write_text(changed(TEXT, RETURNS, "return None"))
    for reference, directory, code, message in (
        (EXAMPLE, CHECKOUT, 0, "12 of 12 checks passed"),
        ("broken:Proportional", tmp_path, 1, "must be a finite"),
        ("nothing:Here", tmp_path, 2, ""),
    ):
        result = run_command("check_controller", reference, cwd=directory, env={**os.environ})
        assert result.returncode == code, result.stderr
        assert message in result.stdout and "Traceback" not in result.stderr
