"""What a watcher receives from real graphs; for a live site see test_watch_command.py."""

from __future__ import annotations

import signal
import time
from collections import defaultdict
from pathlib import Path

import pytest
from graphs import Process, bag_file, wait_for
from mcap.reader import make_reader
from page_inputs import fail
from peers import in_domain

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from greenroof_ros.base.command_line import EXIT_INTERRUPTED
from greenroof_ros.ros.messages import decoder
from greenroof_ros.watch import feed
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.graph_client import PumpRequestError
from greenroof_ros.watch.store import TOPICS, GraphStore

LEVEL = "/roof/level"


def recorded(run: Path) -> dict[str, dict[int, float]]:
    """Return each topic of a bag, with the numbers of the roof's level at their times."""
    messages: defaultdict[str, dict[int, float]] = defaultdict(dict)
    decode = decoder("std_msgs/msg/Float64")
    with bag_file(run).open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            if channel.topic.endswith(LEVEL):
                messages[channel.topic][message.log_time] = decode(message.data)
            else:
                messages[channel.topic] = {}
    return dict(messages)


def test_what_is_received_is_what_is_recorded(
    domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each value at its tick, or at the next one; of a run that is too fast, only reports are."""
    run = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "30", "--hours", "4",
        "--output", "run", cwd=tmp_path,
    )
    watched = GraphStore()
    with in_domain(domain), Feed(watched):
        wait_for(lambda: len(watched.past["roof"].rows) > 30, 400, "levels")
        monkeypatch.setattr(feed, "FASTEST", 0.0)
        time.sleep(1.0)
        newest = dict(watched.newest)
        time.sleep(1.0)
        assert watched.newest == newest and watched.mode == "simulated"
        run.process.send_signal(signal.SIGINT)
        assert run.wait(300) == EXIT_INTERRUPTED, run.stderr()
        wait_for(lambda: watched.mode == "ended", 120, "the end of the run")
    assert watched.now > newest[LEVEL].time  # by the plant's last report
    bag = recorded(tmp_path / "run")
    assert set(TOPICS) & bag.keys() <= {*newest, "/forecast/precipitation", "/controller/plan"}
    assert watched.forecast is not None and watched.forecast.at < 1.7e9  # of the run
    for row in watched.past["roof"].rows:
        near = {value for at, value in bag[LEVEL].items() if 0 <= row["ended"] - at <= 20e9}
        assert row["last"] in near or row["ended"] > max(bag[LEVEL])


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
