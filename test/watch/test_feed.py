"""What a watcher receives from real graphs: each value at its tick, regardless of the speed."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_topics import MPC_TOPICS
from graphs import Process, bag_file, wait_for
from mcap.reader import make_reader
from peers import Peer, in_domain

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Float64

from greenroof_ros.base.command_line import EXIT_INTERRUPTED
from greenroof_ros.watch import feed
from greenroof_ros.watch.document import make_document as read_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.store import GraphStore

LEVEL = "/roof/level"


class Kept(GraphStore):
    """A store that also keeps what it is fed.

    Attributes:
        messages: by topic, the message of each time (ns since 1970).
        modes: the states of the graph that it was given, each once.
        runs: how often it started again.
    """

    def __init__(self) -> None:
        self.messages: defaultdict[str, dict[int, bytes]] = defaultdict(dict)
        self.modes: list[tuple[str, str]] = []
        self.runs = -1  # it starts once on its own
        super().__init__()

    def receive(self, topic: str, time_ns: int, message: bytes) -> None:
        assert time_ns not in self.messages[topic]
        self.messages[topic][time_ns] = message
        super().receive(topic, time_ns, message)

    def set_present(self, **present: Any) -> None:
        said = present["mode"], present["note"]
        if said not in self.modes:
            self.modes.append(said)
        super().set_present(**present)

    def reset(self) -> None:
        self.runs += 1
        self.messages.clear()
        super().reset()


@contextmanager
def fed(domain: int, past_file: Path | None = None) -> Iterator[tuple[Kept, Feed]]:
    watched = Kept()
    with in_domain(domain), Feed(watched, past_file=past_file) as feed:
        yield watched, feed


def recorded(run: Path) -> dict[str, dict[int, bytes]]:
    """Return each message of a bag at its time."""
    messages: defaultdict[str, dict[int, bytes]] = defaultdict(dict)
    with bag_file(run).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            messages[channel.topic][message.log_time] = message.data
    return dict(messages)


def _shown(watched: Kept) -> dict[str, Any]:
    return read_document(watched, time.monotonic())


@contextmanager
def someone(domain: int) -> Iterator[Callable[..., None]]:
    """Be a foreign node, which publishes statuses on /diagnostics, with a time, and a level."""
    with in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        levels = peer.node.create_publisher(Float64, LEVEL, 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def say(*statuses: DiagnosticStatus, stamp_s: int = 0) -> None:
            said = DiagnosticArray(status=list(statuses))
            said.header.stamp.sec = stamp_s
            publisher.publish(said)
            levels.publish(Float64(data=0.04))

        yield say
        peer.close()


def node(role: str, state: str = "ready", name: str = "", **values: Any) -> DiagnosticStatus:
    """Return what a node reports of itself."""
    said = {"role": role, "process": "host 1", **values}
    pairs = [KeyValue(key=key, value=json.dumps(value)) for key, value in said.items()]
    return DiagnosticStatus(name=name or f"/{role}", message=state, values=pairs)


def test_what_is_received_is_what_is_recorded(domain: int, tmp_path: Path) -> None:
    """At 30 times real time: each message at its tick."""
    run = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "30", "--hours", "4",
        "--output", "run", cwd=tmp_path,
    )
    with fed(domain) as (watched, _):
        wait_for(lambda: len(watched.messages[LEVEL]) > 200, 400, "levels")
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
        wait_for(lambda: watched.mode == "ended", 120, "the end of the run")
    assert watched.runs == 0
    bag, received = recorded(tmp_path / "run"), watched.messages
    assert set(received) == MPC_TOPICS - {"/clock"}
    for topic, messages in received.items():
        # At the end one tick more than recorded may have been published.
        late = {at for at in messages if at > max(bag[LEVEL])}
        assert len(late) <= 1
        assert {at: messages[at] for at in messages if at not in late}.items() <= bag[topic].items()
        assert len(messages) > 100, topic


def test_of_a_run_that_is_too_fast_only_the_reports_are_shown(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "FASTEST", 0.0)  # on a busy machine it can be slow
    with fed(domain) as (watched, _):
        run = Process(
            domain, "bringup", "--controller", "onoff", "--hours", "0.25", "--speed", "100",
            "--output", "run", cwd=tmp_path,
        )
        assert run.wait(300) == 0, run.stderr()
        wait_for(lambda: watched.mode == "ended", 60, "the end of the run")
        shown = _shown(watched)
    reason = "This run is faster than 60 times real time"
    assert any(note.startswith(reason) for _, note in watched.modes)
    assert not watched.messages
    assert shown["tiles"]["roof"]["state"] == "unknown"
    assert shown["time"]["text"].startswith("2021-07-")  # by the plant's last report


def test_a_live_site_after_a_run_has_nothing_of_it(domain: int) -> None:
    """A watcher that continues does not show a simulation's level as the site's.

    Before both nothing is received, and after them it ends at once.
    """
    with fed(domain) as (watched, _), someone(domain) as say:
        wait_for(lambda: watched.modes, 60, "a word")
        assert watched.modes == [("none", "")]

        def is_so(mode: str, *nodes: DiagnosticStatus) -> bool:
            say(*nodes, stamp_s=1_626_757_200)
            return watched.mode == mode

        run = {"run_length": 100, "tick": 5}
        wait_for(lambda: is_so("simulated", node("plant", **run)), 60, "the run")
        wait_for(lambda: is_so("ended", node("plant", "ended", **run)), 60, "its end")
        assert watched.runs == 0
        wait_for(lambda: is_so("live", node("controller")), 60, "the live site")
        assert watched.runs == 1
        began = time.monotonic()
    assert time.monotonic() - began < 15
    assert not [thread for thread in threading.enumerate() if thread.name == "graph"]


def test_the_past_of_a_live_site_survives_a_restart(
    domain: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """If its file is damaged, the charts start empty, with a line; a run's past is not kept."""
    file = tmp_path / "state" / "past.npz"

    def watch(*, live: bool = True) -> list[float]:
        """Watch until a level has come, and return the values of its line."""
        said = node("controller") if live else node("plant", run_length=100, tick=5)
        with fed(domain, file) as (watched, _), someone(domain) as say:

            def came() -> bool:
                say(said)
                return bool(watched.messages[LEVEL]) or watched.mode == "simulated"

            wait_for(came, 60, "a level")
        values: list[float] = watched.past["roof"].rows["last"].tolist()
        return values

    assert watch(live=False) == [] and not file.exists()
    assert len(watch()) == 1
    before = file.read_bytes()
    assert len(watch()) in (1, 2) and file.read_bytes() != before
    with np.load(file) as saved:
        assert len(saved["roof"])
    file.write_bytes(before[:-100])
    capfd.readouterr()
    assert len(watch()) == 1
    assert f"the charts start empty: {file} cannot be read" in capfd.readouterr().err


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


class Asked:
    """A client whose pump node answers when the test lets it.

    Attributes:
        done: what was requested of the pump node, in this order.
        answers: set to answer.
    """

    def __init__(self) -> None:
        self.done: list[str] = []
        self.answers = threading.Event()

    def request(self, action: str, *_: Any) -> str:
        self.done.append(action)
        self.answers.wait(60)
        return action


def test_a_stop_goes_before_all_else(monkeypatch: Any) -> None:
    """What was asked before it is not done after it, which would undo it."""
    feed, client = Feed(Kept()), Asked()  # not entered: the client is this one
    monkeypatch.setattr(feed, "_client", client)
    feed._requesting.release()
    answers: dict[str, str] = {}

    def ask(number: int, action: str) -> None:
        try:
            answers[f"{action} {number}"] = feed.request_action(action)
        except PumpRequestError as error:
            answers[f"{action} {number}"] = str(error)

    for number, action in enumerate(
        ("clear", "release", "stop", "dose", "stop", "release")
    ):
        threading.Thread(target=ask, args=(number, action), daemon=True).start()
        wait_for(lambda: client.done == ["clear"], 10, "the first request")
        time.sleep(0.1)  # it waits for the answer to the first
    client.answers.set()
    wait_for(lambda: len(answers) == 6, 60, "the answers")
    assert client.done[:3] == ["clear", "stop", "stop"]  # then perhaps the last release
    del answers["release 5"]
    refused = "Nothing was done: someone is stopping the pump."
    assert answers == {
        "clear 0": "clear", "release 1": refused, "stop 2": "stop", "dose 3": refused,
        "stop 4": "stop",
    }


def test_no_one_who_asks_again_and_again_keeps_a_stop_waiting(monkeypatch: Any) -> None:
    """Each release takes as long as a pump node that does not answer, and the next one follows."""
    feed, client, over = Feed(Kept()), Asked(), threading.Event()
    monkeypatch.setattr(feed, "_client", client)
    monkeypatch.setattr(client.answers, "wait", lambda _: time.sleep(0.5))
    feed._requesting.release()

    def ask() -> None:
        while not over.is_set():
            with suppress(PumpRequestError):
                feed.request_action("release")

    askers = [threading.Thread(target=ask) for _ in range(3)]
    for asker in askers:
        asker.start()
    for _ in range(5):
        wait_for(lambda: client.done[-1:] == ["release"], 10, "a release")
        began = time.monotonic()
        assert feed.request_action("stop") == "stop"
        assert time.monotonic() - began < 2.0  # a release under way, and the stop
    over.set()
    for asker in askers:
        asker.join(60)
