"""A graph's pump is stopped from outside; for what is received see test_beside_a_run.py."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from graphs import wait_for

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import parameter_value_to_python
from ros_rig import Peer, in_domain

from greenroof_ros.watch.graph_client import GraphClient, RequestError

PAGE = {"owner": "the page"}
HELD = "held: a hold by the page"


class Pump(Peer):
    """A pump node's service for a hold, with the answer that a test sets."""

    def __init__(self, domain: int, name: str = "pump", *services: str) -> None:
        super().__init__(domain, name)
        self.requests: list[dict[str, Any]] = []
        self.success, self.answer = True, HELD
        self.answers = threading.Event()
        self.answers.set()
        for service in ("hold", *services):
            self.node.create_service(SetParametersAtomically, f"~/{service}", self._on_hold)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _on_hold(self, request: Any, response: Any) -> Any:
        self.requests.append({
            parameter.name: parameter_value_to_python(parameter.value)
            for parameter in request.parameters
        })
        self.answers.wait(300)
        response.result.successful, response.result.reason = self.success, self.answer
        return response

    def close(self) -> None:
        self.answers.set()
        self._executor.shutdown()
        self._thread.join()
        super().close()


@pytest.fixture
def client(domain: int) -> Iterator[GraphClient]:
    """A client in the domain, which also nodes of this process join."""
    with in_domain(domain):
        client = GraphClient("", lambda *_: None)
        yield client
        client.close()


def refused(client: GraphClient, sentence: str, seconds: float, *, answered: bool) -> None:
    """Request a stop that is not confirmed."""
    with pytest.raises(RequestError, match=sentence) as refusal:
        client.request("stop", seconds, **PAGE)
    assert refusal.value.answered == answered


def test_a_stop_is_answered_by_the_pump_node(domain: int, client: GraphClient) -> None:
    """If it does not state that it holds, that is an error, which is not one of no answer."""
    refused(client, r"no node provides the service hold\. Start", 0.5, answered=False)
    pump = Pump(domain)
    assert client.request("stop", 20, **PAGE) == HELD
    assert client.request("stop", 20, owner="MQTT", reason="frost", until=4e9)
    assert pump.requests == [PAGE, {"owner": "MQTT", "reason": "frost", "until": 4e9}]
    pump.success, pump.answer = False, "held: a hold by the page; but the disk is full"
    refused(client, "the disk is full", 20, answered=True)
    pump.answers.clear()
    refused(client, r"did not answer within 0\.5 s", 0.5, answered=False)
    pump.close()


def test_a_stop_goes_to_every_node_that_may_control_the_pump(
    domain: int, client: GraphClient
) -> None:
    """Also to one that no one has reported; what is not a stop goes to none of several."""
    pumps = [Pump(domain), Pump(domain, "other")]
    wait_for(lambda: client.find_nodes() == {"/pump": 1, "/other": 1}, 60, "both nodes")
    assert client.request("stop", 20, **PAGE) == f"/other: {HELD}; /pump: {HELD}"
    assert [pump.requests for pump in pumps] == [[PAGE]] * 2
    # A node that does not answer keeps the stop from no other.
    pumps[1].answers.clear()
    refused(client, f"/other did not answer .*; /pump: {HELD}", 1.0, answered=False)
    assert len(pumps[0].requests) == 2
    for action in ("release", "clear", "reset", "dose"):
        with pytest.raises(RequestError, match="Nothing was done, because it is unclear"):
            client.request(action, 20)
    # One that has gone is not asked any more, so that the other can be released.
    pumps.pop().close()
    wait_for(lambda: client.find_nodes() == {"/pump": 1}, 60, "the end of the other node")
    # Of two nodes of one name, one can hang although an answer comes.
    pumps.append(Pump(domain))
    wait_for(lambda: client.find_nodes() == {"/pump": 2}, 60, "its twin")
    refused(client, "two nodes have this name", 3.0, answered=False)
    for pump in pumps:
        pump.close()


def test_the_valve_is_no_pump(domain: int, client: GraphClient) -> None:
    """It is told by what it offers, and neither is sent what is meant for the other."""
    pump, valve = Pump(domain), Pump(domain, "valve", "open")
    opening = {"owner": "me", "until": 4e9}
    wait_for(lambda: client.find_nodes() == {"/pump": 1}, 60, "the pump")
    wait_for(lambda: client.find_nodes("valve") == {"/valve": 1}, 60, "the valve")
    client.request("open", 20, "valve", **opening)
    client.request("close", 20, "valve", **PAGE)
    client.request("stop", 20, **PAGE)
    assert (valve.requests, pump.requests) == ([opening, PAGE], [PAGE])
    for each in (pump, valve):
        each.close()
