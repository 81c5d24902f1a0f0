"""A graph's pump is stopped from outside; for what is received see watch/test_feed.py."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from graphs import wait_for
from peers import Peer, in_domain

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import parameter_value_to_python

from greenroof_ros.watch.graph_client import GraphClient, PumpRequestError

PAGE = {"owner": "the page"}


@pytest.fixture
def place(domain: int) -> Iterator[int]:
    """A domain, also for nodes of this process."""
    with in_domain(domain):
        yield domain


class Pump(Peer):
    """A pump node's service for a hold, with the answer that a test sets."""

    def __init__(self, domain: int, name: str = "pump") -> None:
        super().__init__(domain, name)
        self.requests: list[dict[str, Any]] = []
        self.success, self.answer = True, "held: a hold by the page"
        self.answers = threading.Event()
        self.answers.set()
        self.node.create_service(SetParametersAtomically, "~/hold", self._on_hold)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin)
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
        self._executor.shutdown()
        self._thread.join()
        super().close()


def test_hold(place: int) -> None:
    """The pump node's message is returned; if it does not state that it holds, that is an error."""
    client = GraphClient("", lambda *_: None)
    assert not client.find_pumps()
    with pytest.raises(PumpRequestError, match=r"no node provides the service hold\. Start"):
        client.request("stop", 0.5, **PAGE)
    pump = Pump(place)
    assert client.request("stop", 20, **PAGE) == "held: a hold by the page"
    assert client.request("stop", 20, owner="MQTT", reason="frost", until=4e9)
    assert pump.requests == [
        PAGE, {"owner": "MQTT", "reason": "frost", "until": 4e9},
    ]
    pump.success, pump.answer = False, "held: a hold by the page; but the disk is full"
    with pytest.raises(PumpRequestError, match="the disk is full"):
        client.request("stop", 20, **PAGE)
    pump.answers.clear()
    with pytest.raises(PumpRequestError, match=r"did not answer within 0\.5 s"):
        client.request("stop", 0.5, **PAGE)
    pump.answers.set()
    client.close()
    pump.close()


def test_a_stop_goes_to_every_node_that_may_control_the_pump(place: int) -> None:
    """Also to one that no one has reported; what is not a stop goes to none of several."""
    pumps = [Pump(place), Pump(place, "other")]
    client = GraphClient("", lambda *_: None)
    wait_for(lambda: client.find_pumps() == {"/pump": 1, "/other": 1}, 60, "both nodes")
    held = "held: a hold by the page"
    assert client.request("stop", 20, **PAGE) == f"/other: {held}; /pump: {held}"
    assert [pump.requests for pump in pumps] == [[PAGE]] * 2
    # A node that does not answer keeps the stop from no other.
    pumps[1].answers.clear()
    with pytest.raises(PumpRequestError, match=f"/other did not answer .*; /pump: {held}"):
        client.request("stop", 1.0, **PAGE)
    assert len(pumps[0].requests) == 2
    pumps[1].answers.set()
    for action in ("release", "clear", "reset", "dose"):
        with pytest.raises(PumpRequestError, match="Nothing was done, because it is unclear"):
            client.request(action, 20)
    # One that has gone is not asked any more, so that the other can be released.
    pumps.pop().close()
    wait_for(lambda: client.find_pumps() == {"/pump": 1}, 60, "the end of the other node")
    # Of two nodes of one name, one can hang although an answer comes.
    pumps.append(Pump(place))
    wait_for(lambda: client.find_pumps() == {"/pump": 2}, 60, "its twin")
    with pytest.raises(PumpRequestError, match="two nodes have this name"):
        client.request("stop", 3.0, **PAGE)
    pumps.pop().close()
    wait_for(lambda: client.find_pumps() == {"/pump": 1}, 60, "the end of its twin")
    assert client.request("stop", 20, **PAGE) == held
    client.close()
    pumps.pop().close()
