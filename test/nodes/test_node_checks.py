"""Nodes of others under check-controller and check-pump, which name each broken rule."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import pytest
from graphs import Process, changed, start_node
from places import CHECKOUT, CONFIG

CONTROLLER = (CHECKOUT / "examples" / "controller_node.py").read_text()
DRIVER = changed(
    changed(
        (CHECKOUT / "examples" / "pump_driver.py").read_text(),
        "0.008, 30.0, 1.0", "0.008, 4.0, 1.0",  # faster than the example's
    ),
    "SILENCE = 3.0", "SILENCE = 1.0; last = [0.0]",
)
ANSWER = "        publisher.publish(Float64(data=command()))\n"
COMMAND = "GAIN * (TARGET - roof)"
VALVE, SITE = ("-p", "valve:=true"), ("--site", str(CONFIG / "site_valve.yaml"))


class Case(NamedTuple):
    """Changes that break a node, and what is in the lines that must fail: title and problem."""

    changes: dict[str, str]
    failures: dict[str, str]
    node: tuple[str, ...] = ()
    check: tuple[str, ...] = ()


CONTROLLERS = {
    "example": Case({}, {}, VALVE, (*SITE, "--horizon", "120")),
    "obeys_too_much": Case({
        'tick["weather/frost"] != 0': 'tick["weather/frost"] not in (0.0, 1.0)',
        "    finite = all": "    finite = True or all",
        " or not math.isfinite(roof)": "",
        "SUCTION <= cistern < math.inf": "SUCTION <= cistern",
        COMMAND: f'{COMMAND} + 0.0 * sum(tick["forecast/precipitation"][-10:])',
    }, {
        "0 in frost": r"0\.5\d+ on /pump/command, .* after 0 s with 1 on /weather/frost",
        "while /cistern/level": r"0\.5\d+ on /pump/command, .* inf on /cistern/level",
        "while /roof/level": "nan on /pump/command with nan on /roof/level; it must be",
        "while /forecast/prec": "nan on /pump/command with nan on /forecast/precipitation",
        "while /weather/frost": "1 on /outlet/command .* nan on /weather/frost",
    }, VALVE, SITE),
    "careless": Case({
        'tick["weather/frost"] != 0': 'tick["weather/frost"] == 1',
        f"max({COMMAND}, 0.0)": COMMAND,
        "    if topic in tick:\n": "    if False:\n",
        "len(tick) == len(INPUTS)": 'topic == "forecast/evapotranspiration"',
        "tick.clear()": "pass",
        "        raise SystemExit\n": "        pass\n",
    }, {
        "valid at all levels": r"-0\.\d+ on /pump/command with .* on /roof/level",
        "while /weather/frost": r"0\.4\d+ on /pump/command .* nan on /weather/frost",
        "in any order": "before the last input in /cistern/level, .*/forecast/precipitation$",
        "ends with": "still runs 10 s after /clock",
    }),
    "volatile": Case({
        ", durability=DurabilityPolicy.TRANSIENT_LOCAL": "",
        '"weather/frost": Float64,': "", 'tick["weather/frost"] != 0 or ': "",
    }, {
        "topics match": "its publisher of /pump/command must have transient local durability; its "
        "subscription to /cistern/level must have transient local durability.*node has no "
        "subscription to /weather/frost",
    }),
}
# The rules for topics and messages are those of controllers, in the same code.
DRIVERS = {
    "example": Case({}, {}),
    "obeys_too_much": Case({
        "else 0.0  # not a NaN":
            "else last[0] if math.isnan(command) else 0.0\n    last[0] = command",
        "    flow.data = 0.0\n": "    pass\n",
        "node.commanders > 1 or": "node.commanders > 9 or",
        "not cistern > SUCTION": "math.isnan(cistern)",
    }, {
        "command nan": r"0\.00\d+ on /pump/flow after 3 s with nan on /pump/command",
        "of the last command": r"0\.00\d+ m3/s after the silence, 0\.00",
        "second publisher": r"0\.00\d+ on /pump/flow after 3 s with usual inputs",
        "at the suction level": "after 3 s with 0.749 on /cistern/level",
    }),
}


@pytest.mark.parametrize(("kind", "name"), [
    *(("controller", name) for name in CONTROLLERS), *(("pump", name) for name in DRIVERS),
])
def test_examples_pass_and_broken_nodes_fail_for_what_is_broken(
    domain: int, tmp_path: Path, kind: str, name: str
) -> None:
    """Exactly the lines of what is broken fail."""
    text, cases = (DRIVER, DRIVERS) if kind == "pump" else (CONTROLLER, CONTROLLERS)
    case = cases[name]
    for old, new in case.changes.items():
        text = changed(text, old, new)
    there = "--ros-args", "-r", f"__ns:=/{name}", *case.node  # in a namespace of its own
    node = start_node(domain, tmp_path, name, text, *there)
    options = ("--period", "0.01") if kind == "pump" else case.check
    try:
        process = Process(
            domain, f"other_limits.check_{kind}", "--node", f"/{name}/{kind}", *options,
            cwd=tmp_path,
        )
        code, said = process.wait(180), process.stdout()
        failed = [line for line in said.splitlines() if line.startswith("  failed: ")]
        assert code == bool(case.failures), process.stderr()
        assert len(failed) == len(case.failures), said
        for title, problem in case.failures.items():
            assert any(re.search(f"{title}.*{problem}", line) for line in failed), said
        assert kind != "pump" or re.match(r"THE PUMP WILL RUN\. .* takes up to \d minutes", said)
        if not failed:
            assert node.wait(300) == 0  # as the check, which plays all other nodes, has gone
    finally:
        node.kill()
        node.wait(300)


def test_our_controller_is_held_to_the_same_rules(domain: int, tmp_path: Path) -> None:
    """A refused level reads 0, as that of a dry roof, and a refused frost as no frost."""
    node = Process(domain, "nodes.controller", "--controller", "onoff", cwd=tmp_path)
    checked = Process(domain, "check_controller", "--node", "onoff", cwd=tmp_path)
    assert checked.wait(180) == 0, checked.stdout()
    node.wait(60)
