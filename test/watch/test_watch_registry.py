"""Which graph is present, by what nodes report of themselves."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from page_inputs import node

from greenroof_ros.watch.registry import Registry


def say(
    graph: Registry, now: float, role: str, state: str = "ready", name: str = "", **values: Any
) -> None:
    """Have a node of a lockstep graph report its state."""
    graph.receive(now, node(name or f"/{role}", role, state=state, run_length=100, **values))


def test_a_live_site_that_falls_silent_has_not_ended() -> None:
    """A silent live pump may turn; a simulation with all nodes killed has ended."""
    live, simulated = Registry(), Registry()
    for role in ("controller", "pump"):
        live.receive(0.0, node(f"/{role}", role))
    for role in ("plant", "controller"):
        say(simulated, 0.0, role)
    assert (live.mode(1.0), simulated.mode(1.0)) == ("live", "simulated")
    assert (live.mode(60.0), simulated.mode(60.0)) == ("live", "ended")
    for role in ("controller", "pump"):
        live.receive(61.0, node(f"/{role}", role, state="ended"))
    assert live.mode(61.0) == "ended"


def test_a_pump_node_that_is_started_again_is_one() -> None:
    graph = Registry()
    say(graph, 0.0, "pump")
    for at in (0.5, 1.0, 1.5, 2.0, 2.5):
        say(graph, at, "pump", process="host 2")
        assert graph.two_pumps(at) == ""
        pump = graph.pump(at)
        assert pump is not None and pump.process == "host 2"


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
