"""What looks at a graph from outside: what it hears, how it is connected, and the stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from graphs import wait_for
from lookers import Peer, in_domain

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from greenroof_ros.common.interface import read_topics
from greenroof_ros.graph.looker import Looker, StopFailedError
from greenroof_ros.graph.messages import decoder, encoder, qos_profile

LEVEL = "/roof/level"


@pytest.fixture
def place(domain: int) -> Iterator[int]:
    """A domain, also for nodes of this process."""
    with in_domain(domain):
        yield domain


def test_messages_come_with_their_numbers(place: int) -> None:
    """Those that are said while it listens and no older ones, under the graph's namespace.

    A writer knows of its reader before the reader knows of it, and what it says between is not
    heard: so it speaks until it is heard, and from then on nothing may be missing.
    """
    encode, decode = encoder("std_msgs/msg/Float64"), decoder("std_msgs/msg/Float64")
    heard: list[tuple[int | None, float]] = []
    times: list[int] = []
    said = 0

    def take(name: str, message: bytes, number: int | None, arrived_ns: int) -> None:
        assert name == LEVEL
        heard.append((number, decode(message)))
        times.append(arrived_ns)

    def say() -> bool:
        """Say one more, and return whether any was heard since it last began to listen."""
        nonlocal said
        said += 1
        publisher.publish(encode(float(said)))
        looker.look(0.02)
        return bool(heard)

    def heard_last() -> bool:
        looker.look(0.02)
        return heard[-1] == (said, float(said))

    looker = Looker("/site1", take)
    with closing(Peer(place, "gauge", "/site1")) as peer, closing(looker):
        publisher = peer.node.create_publisher(
            Float64, "roof/level", qos_profile(read_topics()[LEVEL].qos)
        )
        for _ in range(2):
            heard.clear()
            for _ in range(3):
                assert not say()
            unheard, before = said, time.time_ns()
            looker.listen([LEVEL])
            wait_for(lambda: publisher.get_subscription_count() == 1, 20, "the subscription")
            wait_for(say, 20, "what was to be heard")
            for _ in range(60):
                say()
            wait_for(heard_last, 20, "what was said last")
            first = heard[0][0]
            assert first is not None and first > unheard
            assert heard == [(one, float(one)) for one in range(first, said + 1)]
            assert all(before <= at <= time.time_ns() for at in times[-len(heard):])
            # It listens to other topics, or to none, and then to this one again.
            looker.listen([])
            wait_for(lambda: publisher.get_subscription_count() == 0, 20, "the end of it")


class Pump(Peer):
    """A pump node's stop service, which answers as it is told."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain, "pump")
        self.asked: list[bool] = []
        self.success, self.words, self.answers_after = True, "held: an operator stopped it", 0.0
        self.node.create_service(SetBool, "~/page_stop", self._on_stop)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._over = False
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _on_stop(self, request: Any, response: Any) -> Any:
        self.asked.append(request.data)
        time.sleep(self.answers_after)
        response.success, response.message = self.success, self.words
        return response

    def _spin(self) -> None:
        while not self._over:
            self._executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._over = True
        self._thread.join()
        super().close()


def test_stop(place: int) -> None:
    """The pump node's words come back; where it does not say that it holds, that is an error."""
    looker = Looker("", lambda *_: None)
    with pytest.raises(StopFailedError, match="no pump node"):
        looker.stop_pump()
    looker.prepare_stop("/pump")
    began = time.monotonic()
    with pytest.raises(StopFailedError, match="/pump has no page_stop service that answers"):
        looker.stop_pump(0.5)
    assert time.monotonic() - began < 2
    pump = Pump(place)
    assert looker.stop_pump(20) == "held: an operator stopped it"
    assert pump.asked == [True]
    pump.success, pump.words = False, "held: an operator stopped it; but the disk is full"
    with pytest.raises(StopFailedError, match="the disk is full"):
        looker.stop_pump(20)
    pump.answers_after = 2.0
    began = time.monotonic()
    with pytest.raises(StopFailedError, match=r"did not answer within 0\.5 s"):
        looker.stop_pump(0.5)
    assert time.monotonic() - began < 2
    looker.prepare_stop(None)
    with pytest.raises(StopFailedError, match="no pump node"):
        looker.stop_pump()
    looker.close()
    pump.close()
