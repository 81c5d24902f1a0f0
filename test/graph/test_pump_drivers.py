"""Pump drivers independent of this package: the example, in a run and under the check."""

from __future__ import annotations

import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from checked_nodes import changed, in_namespace, start_node, wrong_verdict
from graphs import Process, wait_for
from peers import Peer, in_domain
from places import CHECKOUT

pytest.importorskip("rclpy", reason="the check needs ROS 2")

from std_msgs.msg import Float64

DRIVER = CHECKOUT / "examples" / "pump_driver.py"
EXAMPLE = DRIVER.read_text()
# The changes that break the example: each breaks one rule, and exactly the checks of these rules
# must fail, with this message.
BROKEN = {
    "obeys_too_much": [
        (
            "else 0.0  # not a NaN", "else last[0]\n    last[0] = command",
            "rejects commands that", r"3 s after command nan, the flow is still 0\.00\d+ m3/s",
        ),
        (
            "    flow.data = 0.0\n", "    pass\n",
            "of the last command", r"first command after 1\.5 s of silence.*had not stopped",
        ),
        (
            "node.commanders > 1 or", "node.commanders > 9 or",
            "second publisher", r"3 s after a second publisher appeared, the flow",
        ),
        (
            "not cistern > SUCTION", "math.isnan(cistern)",
            "stops when the cistern falls to the suction level",
            r"3 s after the cistern fell",
        ),
    ],
    "hears_too_little": [
        (
            "min(command, 1.0)", "command",
            "above 1 as 1",
            r"the flow is 0\.024 m3/s at command 3, and 0\.00\d+ at command 1",
        ),
        (
            "watchdog = node.create_timer(SILENCE, on_silence,",
            "from std_msgs.msg import String\n"
            "states = node.create_publisher(String, 'pump/state', qos)\n"
            "said = lambda: states.publish(String(data='{\"state\": \"running\"}'))\n"
            "watchdog = node.create_timer(SILENCE, lambda: (on_silence(), said()),",
            "of the last command", r"/pump/state reports 'running' at the end of the silence",
        ),
        (
            "frost != 0", "math.isnan(frost)",
            "stops in frost", r"3 s after 1 on /weather/frost, the flow is still",
        ),
        (
            "SUCTION  # an unknown level",
            "SUCTION + last[0]; last[0] += cistern <= SUCTION  #",
            "runs again once the cistern has refilled",
            r"m3/s after 12 s at command 0\.5",
        ),
        (
            "    publisher.publish(flow)\n", "    publisher.publish(flow)\n" * 2,
            "exactly one flow", r"[2-9] flows instead of 1 after tick",
        ),
    ],
    "acts_at_the_command": [
        (
            "    tick[topic] = message.data\n    if len(tick) < len(INPUTS):\n        return\n",
            "    node.seen = getattr(node, 'seen', {}) | {topic: message.data}\n"
            "    if topic != INPUTS[0] or len(node.seen) < len(INPUTS):\n        return\n"
            "    tick.update(node.seen)\n",
            "waits for all inputs of a tick", r"a flow arrived before the last of /\w+/",
        ),
    ],
    "volatile": [
        (
            "QoSProfile(depth=64, durability=DurabilityPolicy.TRANSIENT_LOCAL)",
            "QoSProfile(depth=64)",
            "its topics match the interface",
            r"publisher of /pump/flow is volatile; it must be reliable",
        ),
    ],
}


def start(domain: int, directory: Path, name: str, source: str) -> subprocess.Popen[bytes]:
    """Start a driver in a separate namespace; its pump is faster than the example's."""
    source = changed(source, "0.008, 30.0, 1.0", "0.008, 4.0, 1.0")
    source = changed(source, "SILENCE = 3.0", "SILENCE = 1.0; last = [0.0]")
    return start_node(domain, directory, name, source, *in_namespace(name))


def check(domain: int, directory: Path, name: str) -> Process:
    return Process(
        domain, "quick_check_pump", "--node", f"/{name}/pump", "--period", "0.01", cwd=directory,
    )


def source_of(name: str) -> str:
    source = EXAMPLE
    for old, new, _, _ in BROKEN.get(name, ()):
        source = changed(source, old, new)
    return source


def wrong_verdicts(domain: int, directory: Path) -> list[str]:
    """Check drivers side by side, and return the verdicts that are wrong, with the reason."""
    directory.mkdir()
    names = ("example", *BROKEN)
    sources = {name: source_of(name) for name in names}  # all, before a process is started
    drivers = {name: start(domain, directory, name, source) for name, source in sources.items()}
    wrong = []
    try:
        checks = {name: check(domain, directory, name) for name in names}
        for name, process in checks.items():
            verdict = wrong_verdict(
                process, {title: problem for _, _, title, problem in BROKEN.get(name, ())}
            )
            if verdict:
                wrong.append(f"{name}: {verdict}")
        output = checks["example"].stdout()
        assert "are the only evidence" in output and ("23 of 23 checks passed" in output or wrong)
        # All checks, and no terminal: a line every ten seconds.
        assert "check " in checks["example"].stderr()
        # Check and controller are gone: a driver then ends its run normally.
        assert drivers["example"].wait(300) == 0
    finally:
        for driver in drivers.values():
            driver.terminate()
            driver.wait(300)
    return wrong


def test_example_passes_and_broken_drivers_fail_for_what_is_broken(
    domain: int, tmp_path: Path
) -> None:
    """A driver is checked in real time; as the machine can stall, a failed check is repeated.

    The example needs nothing from this package.
    """
    assert "greenroof" not in EXAMPLE and len(EXAMPLE.splitlines()) <= 67
    wrong = wrong_verdicts(domain, tmp_path / "once")
    assert not wrong or not wrong_verdicts(domain, tmp_path / "again"), wrong


def test_without_a_driver_or_with_a_second_graph_it_explains(domain: int, tmp_path: Path) -> None:
    absent = Process(domain, "check_pump", "--node", "pumpe", cwd=tmp_path)
    publisher = 'node.create_publisher(Float64, "pump/command", qos)\nwatchdog = '
    driver = start(domain, tmp_path, "taken", changed(EXAMPLE, "\nwatchdog = ", "\n" + publisher))
    try:
        check_again = check(domain, tmp_path, "taken")
        assert absent.wait(300) == 2
        assert "no node pumpe that publishes /pump/flow" in absent.stderr()
        assert check_again.wait(300) == 3
        assert "/taken/pump/command already has a publisher (pump)" in check_again.stderr()
    finally:
        driver.terminate()
        assert driver.wait(300) == 0  # no traceback and no failure at SIGTERM


def test_publisher_that_does_not_fit_is_named_at_once(domain: int, tmp_path: Path) -> None:
    """In one line: the node, its settings, and all that are required."""
    with in_domain(domain), closing(Peer(domain, "pump")) as driver:
        driver.node.create_publisher(Float64, "/pump/flow", 10)  # with rclpy's default settings
        process = Process(domain, "bringup", "--pump", "external", "--output", "run", cwd=tmp_path)
        wait_for(lambda: "warning" in process.stderr(), 60, "a warning")
        process.process.terminate()
        assert process.wait(300) == 130
    warnings = [line for line in process.stderr().splitlines() if "warning" in line]
    assert warnings == [
        "warning: /pump/flow has a publisher with an incompatible QoS (pump): it is volatile, but "
        "must be reliable, transient local, keep last 64; change its QoS, or stop it"
    ]
