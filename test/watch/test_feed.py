"""What a watcher receives from real graphs: each value at its tick, regardless of the speed."""

from __future__ import annotations

import json
import signal
import socket
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_topics import MPC_TOPICS
from graphs import Process, bag_file, bring_up, wait_for
from mcap.reader import make_reader
from numpy.typing import NDArray
from peers import Peer, in_domain
from test_account import STORM, assert_equal

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from greenroof_ros.common.command_line import EXIT_INTERRUPTED
from greenroof_ros.watch import feed, wire
from greenroof_ros.watch.document import document as read_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.store import GraphStore

LEVEL = "/roof/level"
FORECASTS = {"/forecast/precipitation", "/forecast/evapotranspiration"}
NUMBERS = MPC_TOPICS - {"/clock"} - FORECASTS
HEARD, READ = "graph", "bag"  # the threads that listen and read


class Kept(GraphStore):
    """A store that also keeps what it is fed.

    Attributes:
        values: by thread and topic, the value at each time.
        present: the states of the graph that it was given, each once.
        runs: how often it started again.
    """

    def __init__(self) -> None:
        self.values: defaultdict[tuple[str, str], dict[int, Any]] = defaultdict(dict)
        self.present: list[tuple[str, str]] = []
        self.runs = -1  # it starts once on its own
        super().__init__()

    def _keep(self, topic: str, time_ns: int, value: Any) -> None:
        kept = self.values[threading.current_thread().name, topic]
        assert kept.setdefault(time_ns, value) == value

    def add(self, topic: str, times_ns: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        for time_ns, value in zip(times_ns.tolist(), values.tolist(), strict=True):
            self._keep(topic, time_ns, value)
        super().add(topic, times_ns, values)

    def add_present(self, topic: str, time_ns: int, value: float) -> None:
        self._keep(topic, time_ns, value)
        super().add_present(topic, time_ns, value)

    def receive(self, topic: str, time_ns: int, message: bytes, *, past: bool) -> None:
        if (rows := wire.rows(message)) is not None and topic in FORECASTS:
            self._keep(topic, time_ns, rows[0].tolist())
        super().receive(topic, time_ns, message, past=past)

    def set_present(self, **present: Any) -> None:
        said = present["mode"], present["note"]
        if said not in self.present:
            self.present.append(said)
        super().set_present(**present)

    def reset(self) -> None:
        self.runs += 1
        self.values.clear()
        super().reset()

    def of(self, thread: str) -> dict[str, dict[int, Any]]:
        kept = list(self.values.items())  # it grows in other threads
        return {topic: values for (by, topic), values in kept if by == thread}


@contextmanager
def fed(domain: int, bag: Path | None = None) -> Iterator[tuple[Kept, Feed]]:
    watched = Kept()
    with in_domain(domain), Feed(watched, bag=bag) as feed:
        yield watched, feed


def recorded(run: Path) -> dict[str, dict[int, Any]]:
    """Return each value of a bag at its time."""
    values: defaultdict[str, dict[int, Any]] = defaultdict(dict)
    with bag_file(run).open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.name.endswith("Float64"):
                values[channel.topic][message.log_time] = wire.number(message.data)
            elif schema.name.endswith("Float64MultiArray"):
                rows = wire.rows(message.data)
                assert rows is not None
                values[channel.topic][message.log_time] = rows[0].tolist()
    return dict(values)


def _shown(watched: Kept) -> dict[str, Any]:
    return read_document(watched, time.monotonic())


def ended(watched: Kept, run: Path) -> None:
    """Wait until the run has ended, and its recording was read completely.

    The present values do not show this: they are received before they are read, perhaps a tick
    beyond the recording, and come from the first topic of the last batch that was read.
    """
    wait_for(lambda: watched.mode == "ended", 120, "the end of the run")
    bag = recorded(run)
    last = {topic: max(bag[topic]) for topic in NUMBERS & bag.keys()}

    def all_read() -> bool:
        read = watched.of(READ)
        return all(at in read.get(topic, ()) for topic, at in last.items())

    wait_for(all_read, 300, "the last tick of each topic")


def up_to(last_ns: int, values: dict[int, Any]) -> dict[int, Any]:
    """Return a topic's values up to the last recorded tick; at most one may be later."""
    recorded_too = {at: value for at, value in values.items() if at <= last_ns}
    assert len(values) - len(recorded_too) <= 1
    return recorded_too


@contextmanager
def someone(domain: int) -> Iterator[Callable[..., None]]:
    """Be a foreign node, which publishes the given statuses on /diagnostics, with a time."""
    with in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def say(*statuses: DiagnosticStatus, stamp_s: int = 0) -> None:
            said = DiagnosticArray(status=list(statuses))
            said.header.stamp.sec = stamp_s
            publisher.publish(said)

        yield say
        peer.close()


def node(role: str, state: str = "ready", name: str = "", **values: Any) -> DiagnosticStatus:
    """Return what a node reports of itself."""
    said = {"role": role, "process": "host 1", **values}
    pairs = [KeyValue(key=key, value=json.dumps(value)) for key, value in said.items()]
    return DiagnosticStatus(name=name or f"/{role}", message=state, values=pairs)


BEGIN_S = 1_626_757_200
def test_what_is_heard_is_the_bags(domain: int, tmp_path: Path) -> None:
    """At 30 times real time: each value at its tick, also those before the watcher came."""
    run = Process(
        domain, "bringup", "--speed", "30", "--hours", "4", "--output", "run", cwd=tmp_path
    )
    wait_for(lambda: bag_file(tmp_path / "run").exists(), 60, "a bag")
    with fed(domain) as (watched, _):
        wait_for(lambda: len(watched.of(HEARD).get(LEVEL, ())) > 200, 400, "levels")
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
        ended(watched, tmp_path / "run")
    assert watched.runs == 0
    bag, heard, read = recorded(tmp_path / "run"), watched.of(HEARD), watched.of(READ)
    assert set(bag) == set(heard) == MPC_TOPICS - {"/clock"}
    for topic, values in heard.items():
        # None at another tick; at the end one tick more than recorded may have been published.
        assert up_to(max(bag[LEVEL]), values).items() <= bag[topic].items(), topic
    for topic in NUMBERS & bag.keys():
        assert read[topic] == bag[topic], topic
        assert len(heard[topic]) > 100, topic


def test_of_a_fast_run_the_bag_is_read_or_samples_are_shown(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only /diagnostics is received; the water account equals the run's own summary."""
    monkeypatch.setattr(feed, "FASTEST", 0.0)  # on a busy machine it can be slow
    options = ("--controller", "onoff", "--hours", "0.25", *STORM)
    with fed(domain) as (watched, _):
        run = Process(
            domain, "bringup", *options, "--speed", "100", "--no-record", "--output", "first",
            cwd=tmp_path,
        )
        assert run.wait(300) == 0, run.stderr()
        wait_for(lambda: watched.mode == "ended", 60, "the end of the run")
        assert any(note.startswith("Shows samples: ") for _, note in watched.present)
        samples = watched.of(HEARD)
        assert set(samples) == {LEVEL, "/cistern/level", "/pump/command"}
        assert len(samples[LEVEL]) > 3
        assert watched.runs == 0
        # The same again, but recorded, is another run.
        summary = bring_up(domain, tmp_path, *options, "--speed", "100", output="second")
        ended(watched, tmp_path / "second")
        assert watched.runs >= 1
        bag, heard = recorded(tmp_path / "second"), watched.of(HEARD)
        for topic in (LEVEL, "/cistern/level"):
            assert samples[topic].items() <= bag[topic].items()
        # Samples from /diagnostics, until the recorder has reported its bag.
        assert set(heard) <= set(samples)
        assert all(values.items() <= bag[topic].items() for topic, values in heard.items())
        assert watched.of(READ)[LEVEL] == bag[LEVEL]
        account = _shown(watched)["account"]
        totals = {row["key"]: row["number"] for row in account["rows"]}
        assert_equal(totals, summary)
        assert totals["overflow"] > 0.1 and totals["drained"] > 1e-3
        assert "gaps" not in account["sentence"]


def test_stop_is_for_the_one_pump_node_that_is_shown(domain: int) -> None:
    """No such node, and two nodes that claim the pump, are refused in words, and soon."""
    pump, other = (
        node("pump", name=name, process=process) for name, process in
        (("/pump", "a 1"), ("/other", "b 1"))
    )

    def refusal(feed: Feed) -> str:
        began = time.monotonic()
        with pytest.raises(PumpRequestError) as refused:
            feed.request_action("stop", owner="the page")
        assert time.monotonic() - began < 15
        return str(refused.value)

    with fed(domain) as (watched, feed), someone(domain) as say:

        def stop_of(*pumps: DiagnosticStatus) -> dict[str, Any]:
            say(*pumps)
            return _shown(watched)["stop"]

        assert "no pump node" in refusal(feed)
        wait_for(lambda: stop_of(pump)["node"] == "/pump", 60, "the pump node")
        assert refusal(feed).startswith("/pump does not answer: ")
        wait_for(lambda: stop_of(pump, other)["warning"], 60, "a warning")
        assert not stop_of(pump, other)["possible"]
        assert "/pump (a 1) and /other (b 1)" in refusal(feed)


def test_a_bag_that_is_followed_before_its_run_is_described(domain: int, tmp_path: Path) -> None:
    """The controller is read at the end; events before any value are in the run's time."""
    with fed(domain, tmp_path / "bag") as (watched, _), someone(domain) as say:
        wait_for(
            lambda: any("There is no recording at" in note for *_, note in watched.present), 60,
            "the note",
        )

        def is_so(state: str, mode: str) -> bool:
            run = {"process": f"{socket.gethostname()} 1", "run_length": 100}
            say(node("plant", state, tick=5, **run), node("recorder", state, **run),
                stamp_s=BEGIN_S)
            say(DiagnosticStatus(name="/fan"))
            return watched.mode == mode

        wait_for(lambda: is_so("ready", "simulated"), 60, "the run")
        (tmp_path / "summary.json").write_text('{"controller": "mpc"}')
        wait_for(lambda: is_so("finished", "ended"), 60, "its end")
        wait_for(
            lambda: _shown(watched)["tiles"]["controller"]["value"] == "mpc", 60, "its controller"
        )
        events = _shown(watched)["events"]
        assert "The run ended." in [event["what"] for event in events]
        assert {event["at"] for event in events} == {BEGIN_S}


def test_a_live_site_after_a_run_has_nothing_of_it(domain: int) -> None:
    """A watcher that continues does not show a simulation's level as the site's.

    Before both nothing is received, and after them it ends at once.
    """
    with fed(domain) as (watched, _), someone(domain) as say:
        wait_for(lambda: watched.present, 60, "a word")
        assert watched.present == [("none", "")]

        def is_so(mode: str, *nodes: DiagnosticStatus) -> bool:
            say(*nodes, stamp_s=BEGIN_S)
            return watched.mode == mode

        run = {"run_length": 100, "tick": 5}
        wait_for(lambda: is_so("simulated", node("plant", **run)), 60, "the run")
        wait_for(lambda: is_so("ended", node("plant", "ended", **run)), 60, "its end")
        assert watched.runs == 0
        wait_for(lambda: is_so("live", node("controller")), 60, "the live site")
        assert watched.runs == 1
        began = time.monotonic()
    assert time.monotonic() - began < 15
    assert not [thread for thread in threading.enumerate() if thread.name == HEARD]


class Broken(Kept):
    """A store that raises when it is given what is watched."""

    def set_present(self, **_: Any) -> None:
        raise ValueError("broken")


def test_a_stop_is_answered_if_all_else_fails(domain: int) -> None:
    with in_domain(domain), Feed(Broken()) as feed:
        time.sleep(0.5)
        began = time.monotonic()
        with pytest.raises(PumpRequestError, match="no pump node"):
            feed.request_action("stop", owner="the page")
        assert time.monotonic() - began < 15


def test_a_stop_goes_before_what_was_asked_before_it_which_is_not_done() -> None:
    """A release that is done after a stop would undo it."""
    feed = Feed(Kept())  # not entered: no one answers
    answers: dict[int, str] = {}

    def ask(number: int, action: str) -> None:
        with pytest.raises(PumpRequestError) as failed:
            feed.request_action(action)
        answers[number] = str(failed.value)

    for number, action in enumerate(("release", "stop", "dose", "stop", "release")):
        threading.Thread(target=ask, args=(number, action), daemon=True).start()
        wait_for(lambda a=action: feed._requests and feed._requests[-1][0] == a, 10, "the request")
    wait_for(lambda: len(answers) == 2, 60, "the end of what came before a stop")
    assert [action for action, *_ in feed._requests] == ["stop", "stop", "release"]
    assert answers.keys() == {0, 2}
    assert {*answers.values()} == {"Nothing was done: someone is asking to stop the pump."}
