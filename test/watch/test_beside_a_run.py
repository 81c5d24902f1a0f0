"""Watchers next to a real run, which is the same run, and does not wait for them."""

from __future__ import annotations

import asyncio
import filecmp
import json
import os
import re
import signal
import struct
from pathlib import Path

import pytest
from graphs import Process, bag_file, bring_up, wait_for
from mcap.reader import make_reader
from page_inputs import read_state
from test_watch_command import child_of, end, refuses_other_addresses, watcher

pytest.importorskip("foxglove", reason="serves Foxglove")
pytest.importorskip("rclpy", reason="nodes need ROS 2")

import aiohttp
from ros_rig import in_domain

from greenroof_ros.ros.messages import decoder
from greenroof_ros.watch.feed import Feed
from greenroof_ros.watch.store import GraphStore

LEVEL, FLOAT = "/roof/level", "std_msgs/msg/Float64"
URL = re.compile(r"ws://127\.0\.0\.1:(\d+)\n")
# A binary frame with a message: its kind, subscription and time (ns), and then the message.
MESSAGE, HEAD, NUMBER = 1, struct.Struct("<BIQ"), struct.Struct("<4xd")


async def receive(port: int, number: int) -> dict[int, float]:
    """Subscribe to the level as Foxglove does; return values by their times (ns)."""
    channels, found = dict[str, int](), dict[int, float]()
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{port}", protocols=["foxglove.sdk.v1"]) as socket,
    ):
        await socket.receive_str()  # what it can do
        while LEVEL not in channels:
            message = json.loads(await socket.receive_str())
            channels |= {each["topic"]: each["id"] for each in message["channels"]}
        await socket.send_json({
            "op": "subscribe", "subscriptions": [{"id": 7, "channelId": channels[LEVEL]}]
        })
        while len(found) < number:
            frame = await socket.receive()
            if frame.type is aiohttp.WSMsgType.BINARY and frame.data[0] == MESSAGE:
                _, _, time_ns = HEAD.unpack_from(frame.data)
                (found[time_ns],) = NUMBER.unpack(frame.data[HEAD.size:])
    return found


def test_a_run_under_the_eyes_of_five_is_the_same_run(domain: int, tmp_path: Path) -> None:
    """What they receive is what is recorded, each value at its tick, or at the next one.

    A page that waits for it, one that is stopped, a client of Foxglove, a store, and its own page,
    which is killed.
    """
    options, watched = ("--controller", "onoff", "--hours", "1"), GraphStore()
    page, port = watcher(domain, tmp_path)
    stopped, _ = watcher(domain, tmp_path)
    viewer = Process(domain, "watch", "--foxglove", "0", cwd=tmp_path)
    served = int(wait_for(lambda: URL.search(viewer.stdout()), 60, "an address")[1])
    assert refuses_other_addresses(served)
    with in_domain(domain), Feed(watched):
        run = Process(
            domain, "bringup", *options, "--speed", "60", "--watch", "--output", "run",
            cwd=tmp_path,
        )
        wait_for(lambda: read_state(port)["mode"] == "simulated", 60, "the run on the page")
        stopped.process.send_signal(signal.SIGSTOP)
        killed = wait_for(lambda: child_of(run), 60, "a watcher")
        os.kill(killed, signal.SIGKILL)
        run.until_printed("the watcher has exited, and starts again in 2 s")
        found = asyncio.run(receive(served, 5))
        wait_for(lambda: child_of(run) not in (0, killed), 60, "another watcher")
        assert run.wait(120) == 0, run.stderr()
        for mode in (lambda: read_state(port)["mode"], lambda: watched.mode):
            wait_for(lambda mode=mode: mode() == "ended", 60, "the end of the run")
    stopped.process.send_signal(signal.SIGCONT)
    for process in (page, stopped, viewer):
        end(process, signal.SIGTERM)
    bring_up(domain, tmp_path, *options, output="alone")
    bags = [bag_file(tmp_path / name) for name in ("run", "alone")]
    assert filecmp.cmp(*bags, shallow=False)
    with bags[0].open("rb") as stream:
        bag = {message.log_time: decoder(FLOAT)(message.data)
               for _, _, message in make_reader(stream).iter_messages([LEVEL])}
    past = {int(row["ended"]): row["last"] for row in watched.past["roof"].rows}
    assert past
    for at, value in (*past.items(), *found.items()):
        assert value in {each for time_ns, each in bag.items() if abs(at - time_ns) <= 20e9}
