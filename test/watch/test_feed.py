"""What a watcher receives from real graphs, and what it keeps."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from graphs import Process, bag_file, wait_for
from mcap.reader import make_reader
from page_inputs import fail
from peers import Peer, in_domain

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Float64

from greenroof_ros.base.command_line import EXIT_INTERRUPTED
from greenroof_ros.ros.messages import decoder
from greenroof_ros.watch import feed
from greenroof_ros.watch.document import make_document
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.store import TOPICS, GraphStore

LEVEL = "/roof/level"


@contextmanager
def fed(domain: int, past_file: Path | None = None) -> Iterator[GraphStore]:
    watched = GraphStore()
    with in_domain(domain), Feed(watched, past_file):
        yield watched


def recorded(run: Path) -> dict[str, dict[int, bytes]]:
    """Return each message of a bag at its time."""
    messages: defaultdict[str, dict[int, bytes]] = defaultdict(dict)
    with bag_file(run).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            messages[channel.topic][message.log_time] = message.data
    return dict(messages)


def test_what_is_received_is_what_is_recorded(domain: int, tmp_path: Path) -> None:
    """At 30 times real time; each value at its tick, or at the next one."""
    run = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "30", "--hours", "4",
        "--output", "run", cwd=tmp_path,
    )
    with fed(domain) as watched:
        wait_for(lambda: len(watched.past["roof"].rows) > 30, 400, "levels")
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
        wait_for(lambda: watched.mode == "ended", 120, "the end of the run")
    assert set(TOPICS) & recorded(tmp_path / "run").keys() <= {
        *watched.newest, "/forecast/precipitation", "/controller/plan",
    }
    assert watched.forecast is not None and watched.forecast.at < 1.7e9  # of the run
    decode = decoder("std_msgs/msg/Float64")
    bag = {at: decode(data) for at, data in recorded(tmp_path / "run")[LEVEL].items()}
    for row in watched.past["roof"].rows:
        near = {value for at, value in bag.items() if 0 <= row["ended"] - at <= 20e9}
        assert row["last"] in near or row["ended"] > max(bag)


def test_of_a_run_that_is_too_fast_only_the_reports_are_shown(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "FASTEST", 0.0)  # on a busy machine it can be slow
    with fed(domain) as watched:
        run = Process(
            domain, "bringup", "--controller", "onoff", "--hours", "0.25", "--speed", "100",
            "--output", "run", cwd=tmp_path,
        )
        assert run.wait(300) == 0, run.stderr()
        wait_for(lambda: watched.mode == "ended", 60, "the end of the run")
        shown = make_document(watched, time.monotonic())
    assert not watched.newest
    assert shown["time"]["text"].startswith("2021-07-")  # by the plant's last report


@contextmanager
def someone(domain: int) -> Iterator[Callable[..., None]]:
    """Be a foreign node, which publishes what a node reports of itself, and a level."""
    with in_domain(domain):
        peer = Peer(domain, "stranger")
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        levels = peer.node.create_publisher(Float64, LEVEL, 10)
        wait_for(lambda: publisher.get_subscription_count() == 1, 60, "the subscription")

        def say(role: str, state: str = "ready", **values: Any) -> None:
            said = {"role": role, "process": "host 1", **values}
            pairs = [KeyValue(key=key, value=json.dumps(value)) for key, value in said.items()]
            publisher.publish(DiagnosticArray(status=[
                DiagnosticStatus(name=f"/{role}", message=state, values=pairs)
            ]))
            levels.publish(Float64(data=0.04))

        yield say
        peer.close()


def watch_until_live(domain: int, file: Path, *, after_a_run: bool) -> list[float]:
    """Watch a live site until a level has come, and return the levels; end at once."""
    with fed(domain, file) as watched, someone(domain) as say:

        def is_so(mode: str, *said: str, **values: Any) -> bool:
            say(*said, **values)
            return watched.mode == mode and (mode != "live" or LEVEL in watched.newest)

        if after_a_run:
            assert watched.mode == "none"
            run = {"run_length": 100, "tick": 5}
            wait_for(lambda: is_so("simulated", "plant", **run), 60, "the run")
            watched.add(LEVEL, 10**18, 0.03)
            wait_for(lambda: is_so("ended", "plant", "ended", **run), 60, "its end")
            assert LEVEL in watched.newest and not file.exists()
        wait_for(lambda: is_so("live", "controller"), 60, "the live site, and a level")
        began = time.monotonic()
    assert time.monotonic() - began < 15
    levels: list[float] = watched.past["roof"].rows["last"].tolist()
    return levels


def test_a_live_site_has_nothing_of_a_run_and_its_past_survives_a_restart(
    domain: int, tmp_path: Path
) -> None:
    """A run's past is not kept."""
    file = tmp_path / "state" / "past.npz"
    assert watch_until_live(domain, file, after_a_run=True) == [0.04]
    before = np.load(file)["roof"]["ended"].tolist()
    assert set(watch_until_live(domain, file, after_a_run=False)) == {0.04}
    after = np.load(file)["roof"]["ended"].tolist()
    assert after[-1] > before[-1] and (before[:1] == after[:1] or len(after) == 1)
    assert not [thread for thread in threading.enumerate() if thread.name == "graph"]


def test_a_stop_is_answered_if_all_else_fails(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(GraphStore, "update", fail)
    with in_domain(domain), Feed(GraphStore()) as watcher:
        time.sleep(0.5)
        began = time.monotonic()
        with pytest.raises(PumpRequestError, match="no pump node"):
            watcher.request_action("stop", owner="the page")
        assert time.monotonic() - began < 15
