"""Which graph is present, by what nodes report of themselves."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest
from page_inputs import node

from greenroof_ros.watch.registry import Registry


def say(
    graph: Registry, now: float, role: str, state: str = "ready", name: str = "", **values: Any
) -> None:
    """Have a node of a lockstep graph report its state."""
    graph.receive(now, node(name or f"/{role}", role, state=state, run_length=100, **values))


def test_a_live_site_that_falls_silent_has_not_ended() -> None:
    """Then nobody waters the roof; a simulation with all nodes killed has ended."""
    live, simulated = Registry(), Registry()
    for role in ("controller", "pump"):
        live.receive(0.0, node(f"/{role}", role))
    for role in ("plant", "controller"):
        say(simulated, 0.0, role)
    assert (live.mode(1.0), simulated.mode(1.0)) == ("live", "simulated")
    assert (live.mode(60.0), simulated.mode(60.0)) == ("live", "ended")
    for role in ("controller", "pump"):
        live.receive(61.0, node(f"/{role}", role, state="ended"))
    assert (live.mode(61.0), live.gone_since(61.0)) == ("live", 0.0)
    say(live, 62.0, "plant")  # a run is another graph
    assert (live.mode(62.0), live.mode(90.0), live.gone_since(90.0)) == (
        "simulated", "ended", None
    )


def test_a_pump_node_that_is_started_again_is_one() -> None:
    graph = Registry()
    say(graph, 0.0, "pump")
    for at in (0.5, 1.0, 1.5, 2.0, 2.5):
        say(graph, at, "pump", process="host 2")
        assert graph.two_pumps(at) == ""
        pump = graph.pump(at)
        assert pump is not None and pump.process == "host 2"


@pytest.mark.parametrize(("reported", "offered", "two"), [
    (["/pump"], ["/pump"], False), ([], ["/pump"], False), (["/other/pump"], ["/pump"], False),
    (["/pump", "/forged"], ["/pump"], True), (["/pump"], ["/pump", "/second"], True),
    (["/forged"], ["/pump"], True),
])
def test_each_node_that_may_be_the_pump_node_is_stopped_and_several_are_an_alarm(
    reported: list[str], offered: list[str], two: bool
) -> None:
    """By its service, or by what is reported of this namespace."""
    graph = Registry()
    graph.offered = offered
    for name in reported:
        say(graph, 0.0, "pump", name=name)
    own = {*offered, *reported} - {"/other/pump"}
    assert {*graph.pumps(0.0)} == own
    codes = [diagnosis.code for diagnosis in graph.diagnoses(0.0).values()]
    assert (codes == ["two_pump_nodes"]) == bool(graph.two_pumps(0.0)) == two


def test_processes_that_report_once_hide_no_other() -> None:
    graph = Registry()
    for step in range(50):
        at = step / 10
        say(graph, at, "pump", process="host 1" if step % 10 == 0 else f"forged {step}")
        diagnosis = graph.diagnoses(at).get("/pump")
        assert (diagnosis is not None and diagnosis.code == "two_processes") == (step >= 10)
        assert bool(graph.two_pumps(at)) == (step >= 10)


def test_a_copied_process_is_known_by_the_numbers_of_its_messages() -> None:
    """Of one publisher they rise, also if some were lost."""
    graph = Registry()
    for at, number, two in ((0.0, 7, False), (1.0, 9, False), (1.2, 1, True), (2.0, 10, True),
                            (4.0, 12, True), (5.0, 13, False)):
        graph.receive(at, node("/pump", "pump"), number=number)
        assert bool(graph.two_pumps(at)) == ("/pump" in graph.diagnoses(at)) == two, at


def test_forged_nodes_take_no_room_from_others() -> None:
    graph = Registry()
    say(graph, 0.0, "pump")
    for number in range(1000):
        for role in ("pump", "weather", f"role {number}"):
            say(graph, 1.0, role, name=f"/{role}{number}", process=f"host {number}")
    say(graph, 2.0, "weather", name="/pump")  # of the same process
    say(graph, 2.0, "controller")
    assert graph.pump(2.0) is graph.node("pump") and graph.node("controller") is not None
    assert "/pump" in graph.pumps(2.0) and len(graph.pumps(2.0)) < 10
    assert "and 5 more" in graph.two_pumps(2.0)
    for role in ("pump", "weather"):
        say(graph, 12.0, role, name=f"/{role}")
    assert graph.diagnoses(12.0).keys() == {"/controller"}  # silent for 10 s


def test_the_time_of_a_run_is_its_plants_after_the_first_tick() -> None:
    """Before, a node stamps with the system's time; no other node has a say."""
    graph = Registry()
    for tick, role, stamp_ns, known in (
        (0, "plant", 5, 0), (1, "controller", 5, 0), (1, "plant", 7, 7), (2, "plant", 2**62, 7),
    ):
        graph.receive(0.0, node(f"/{role}", role, tick=tick, run_length=100), stamp_ns=stamp_ns)
        assert graph.time_ns == known


def test_what_ros_lets_no_node_be_called_is_none() -> None:
    graph = Registry()
    for name in ("pump", "/1", "/" + "p" * 300, "/x: y"):
        say(graph, 0.0, "pump", name=name)
        assert graph.pump(0.0) is None, name


def test_a_site_file_is_what_a_node_of_this_machine_reports(tmp_path: Path) -> None:
    here = f"{socket.gethostname()} 1"
    for process, place, site in (
        (here, f"{tmp_path}", tmp_path), ("another 1", f"{tmp_path}", None),
        (here, f"{tmp_path}/none", None), (here, "/etc/passwd\0", None), (here, ".", None),
        (here, 7, None), (here, "/" + "p" * 5000, None),
    ):
        graph = Registry()
        say(graph, 0.0, "controller", process=process, site=place)
        assert graph.site() == site, place
