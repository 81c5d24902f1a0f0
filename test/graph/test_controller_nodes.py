"""Controllers' nodes under ``check-controller --node``: good ones, and one for each broken rule."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from checked_nodes import changed, in_namespace, start_node, wrong_verdict
from commands import Forked
from graphs import Process, environment
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the check needs ROS 2")

EXAMPLE = (CHECKOUT / "examples" / "controller_node.py").read_text()
PUBLISH = "        publisher.publish(Float64(data=command()))\n"
COMMAND = "GAIN * (TARGET - roof)"
# Variations of the example: changes, and exactly the checks that must fail, with this problem.
BROKEN: dict[str, tuple[list[tuple[str, str]], dict[str, str]]] = {
    "obeys_too_much": (
        [
            ('tick["weather/frost"] != 0', 'tick["weather/frost"] not in (0.0, 1.0)'),
            (" or not math.isfinite(roof)", ""),
            ("SUCTION <= cistern < math.inf", "SUCTION <= cistern"),
        ],
        {
            "commands 0 in frost": r"the command is 0\.9\d+ with 1 on /weather/frost",
            "while the cistern's level": r"the command is 0\.9\d+ with inf on /cistern/level",
            "while the roof's level": "the command is nan with nan on /roof/level",
        },
    ),
    "careless": (
        [
            ('tick["weather/frost"] != 0', 'tick["weather/frost"] == 1'),
            (f"max({COMMAND}, 0.0)", COMMAND),
            ("    if topic in tick:\n", "    if False:\n"),
            ("len(tick) == len(INPUTS)", 'topic == "forecast/evapotranspiration"'),
            ("tick.clear()", "pass"),
            ("node.create_timer", "publisher.publish(Float64())\nnode.create_timer"),
            ("        raise SystemExit\n", "        pass\n"),
        ],
        {
            "before the first tick": "1 commands arrived before any input",
            "finite and not negative": r"the command is -0\.\d+ with .* on /roof/level",
            "while frost is not finite": r"the command is 0\.9\d+ with nan on /weather/frost",
            "waits for all inputs":
                "answers before it has received the tick's message on /cistern/level",
            "ends when": "still running 10 s after the publisher of /clock disappeared",
        },
    ),
    "by_arrival": (  # takes the first message of a tick for the level of the cistern, and so on
        [(PUBLISH, f"        tick.update(dict(zip(INPUTS, tick.values())))\n{PUBLISH}")],
        {"waits for all inputs": r"the command is .* if /cistern/level comes last, but 0\.9\d+ in"},
    ),
    "poisoned": (
        [(COMMAND, f'{COMMAND} + 0.0 * sum(tick["forecast/precipitation"][-10:])')],
        {"stay valid": "the command is nan with nan on /forecast/precipitation"},
    ),
    "silent": (
        [("        publisher.", '        tick["weather/frost"] == 1 or publisher.')],
        {"answers every tick": "no command within 2 s in tick 2 with 1 on /weather/frost$"},
    ),
    "doubled": (
        [(PUBLISH, 2 * PUBLISH)],
        {"exactly one command": "2 commands instead of 1 after tick 0"},
    ),
    "never_waters": (
        [("GAIN = 20.0", "GAIN = 0.0")],
        {"waters a dry roof": "the command is 0 at all levels and forecasts"},
    ),
    "volatile": (
        [
            (", durability=DurabilityPolicy.TRANSIENT_LOCAL", ""),
            ('"weather/frost": Float64,', ""), ('tick["weather/frost"] != 0 or ', ""),
        ],
        {"topics match": "its publisher of /pump/command is volatile; it must be reliable, "
                       "transient local, keep last 64, with a liveliness lease of 1 s; its "
                       "subscription to /cistern/level is volatile.*node has no subscription to "
                       "/weather/frost"},
    ),
}
# Good nodes: the example, and this package's lookahead, which has a memory and limits the starts.
GOOD = ("example", "lookahead")


def start(domain: int, directory: Path, name: str) -> subprocess.Popen[bytes]:
    """Start a node in a namespace of its own."""
    if name == "lookahead":
        return Forked(
            [sys.executable, "-m", "greenroof_ros.nodes.controller", "--controller", name,
             *in_namespace(name)],
            cwd=directory, env=environment(domain),
        )
    source = EXAMPLE
    for old, new in BROKEN.get(name, ([], {}))[0]:
        source = changed(source, old, new)
    return start_node(domain, directory, name, source, *in_namespace(name))


def check(domain: int, directory: Path, name: str) -> Process:
    node = name if name == "lookahead" else "controller"
    return Process(
        domain, "quick_check_controller", "--node", f"/{name}/{node}",
        *(["--horizon", "120"] if name == "lookahead" else []), cwd=directory,
    )


def wrong_verdicts(domain: int, directory: Path) -> list[str]:
    """Check a few nodes at a time, and return the verdicts that are wrong."""
    directory.mkdir()
    names, wrong = [*GOOD, *BROKEN], []
    for some in (names[::2], names[1::2]):
        nodes = {name: start(domain, directory, name) for name in some}
        try:
            checks = {name: check(domain, directory, name) for name in some}
            for name, process in checks.items():
                verdict = wrong_verdict(process, BROKEN.get(name, ([], {}))[1])
                if verdict:
                    wrong.append(f"{name}: {verdict}")
            # That it leaves the graph is checked above. Its process may still lock up in Fast DDS,
            # which can when several nodes shut down at the same time.
            if "example" in some and nodes["example"].poll() not in (0, None):
                wrong.append(f"example: ends with {nodes['example'].poll()}")
        finally:
            for node in nodes.values():
                node.kill()
                node.wait(300)
    return wrong


def test_good_nodes_pass_and_broken_ones_fail_for_what_is_broken(
    domain: int, tmp_path: Path
) -> None:
    """As the machine can stall, a failed check is repeated."""
    wrong = wrong_verdicts(domain, tmp_path / "once")
    assert not wrong or not wrong_verdicts(domain, tmp_path / "again"), wrong
