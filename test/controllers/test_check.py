"""check_controller: this package's controllers and the example pass, broken ones fail."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import changed
from paper import PAPER_SITE
from places import CHECKOUT

from greenroof_ros.controllers.check import check_controller
from greenroof_ros.controllers.registry import BUILT_IN, find_controller

EXAMPLE = "examples.proportional:Proportional"
TEXT = (CHECKOUT / "examples" / "proportional.py").read_text()
RETURNS = "return min(command, 1.0) if command > 0 else 0.0"
HEAD = "    parameters = (\n"


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


# The change, and words of the rule that it breaks.
@pytest.mark.parametrize(("change", "rule"), [
    (returning("return -command if command else 0.0"), "finite and not negative"),
    (returning("return command if self.gain else -1.0"), "either end of its range"),
    (returning("import random; return command * random.random()"), "the same inputs"),
    (returning("evapotranspiration[0] = 1.0; return command"), "does not modify the forecasts"),
    (returning("precipitation[3]; return command"), "a missing or invalid forecast"),
    ({"statistics(self) -> None:\n": 'statistics(self):\n        return {"solves": 1}\n'},
     "statistics()"),
    # The node can only send an array of floats with the interface's columns.
    ({HEAD: '    outputs = {"/controller/plan": "plan"}\n    import numpy\n'
        f"    plan = numpy.zeros((2, 4), dtype=int)\n{HEAD}"}, "a topic of the interface"),
    *((opening(share), "the outlet valve itself") for share in (
        "1.2", "float('nan')", "None", "{}[0]", "__import__('random').random()",
        "self.__dict__.setdefault('shares', [1.0, 0.5]).pop()",
    )),
    (opening("self.gain / 20"), "either end of its range"),
    ({"self.gain = gain": "self.gain = gain; self.outlet = 0.0"}, "the outlet valve itself"),
    (opening("__import__('numpy').float32(1)"), ""),
    (opening("-0.0"), ""),
])
def test_changed_controllers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, str], rule: str
) -> None:
    """Each broken one fails for its own reason; without a rule, all is right."""
    ((old, new),) = change.items()
    (tmp_path / "changed.py").write_text(changed(TEXT, old, new))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "changed", raising=False)
    problems = check_controller(find_controller("changed:Proportional"), PAPER_SITE)
    broken = [name for name, problem in problems.items() if problem]
    assert any(rule in name for name in broken) if rule else not broken


NEEDS_A_VALVE = """
class Needs:
    parameters = ()
    outlet = 0.0
    def __init__(self, site):
        assert site.low_outlet_valve
    def command(self, cistern, roof, rain, evaporated):
        return 0.0, 1.0
"""


def test_the_command(tmp_path: Path) -> None:
    """Exit code 0 if all is right, also for a class that needs a valve, 1 if something is wrong."""
    (tmp_path / "broken.py").write_text(changed(TEXT, RETURNS, "return None"))
    (tmp_path / "needs.py").write_text(NEEDS_A_VALVE)
    for reference, code, message in (
        ("needs:Needs", 0, "12 of 12 checks passed"),
        ("broken:Proportional", 1, "must be a finite"), ("nothing:Here", 2, ""),
    ):
        result = run_command("check_controller", reference, cwd=tmp_path, env={**os.environ})
        assert result.returncode == code, result.stderr
        assert message in result.stdout and "Traceback" not in result.stderr
