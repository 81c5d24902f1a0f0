"""``--foxglove`` as processes: a client over a WebSocket, as Foxglove and Lichtblick are."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import Process, alive, children_of, environment, wait_for
from test_watch_command import tcp_addresses_of

from greenroof_ros.interface.topics import read_topics

pytest.importorskip("aiohttp", reason="the client uses it")
pytest.importorskip("foxglove", reason="serves Foxglove")
pytest.importorskip("rclpy", reason="nodes need ROS 2")

import aiohttp
from test_feed import recorded

URL = re.compile(r"ws://127\.0\.0\.1:(\d+)\n")
# A binary frame with a message: its kind, subscription and time (ns), and then the message.
MESSAGE, HEAD, NUMBER = 1, struct.Struct("<BIQ"), struct.Struct("<4xd")


def port_of(read: Callable[[], str]) -> int:
    """Wait for the address that a process prints, and return its port."""
    return int(wait_for(lambda: URL.search(read()), 60, "an address")[1])


async def receive(port: int, topic: str, number: int) -> tuple[dict[str, Any], dict[int, float]]:
    """Subscribe as a viewer does; return a topic's channel, and some values by their times (ns)."""
    channels, found = dict[str, dict[str, Any]](), dict[int, float]()
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{port}", protocols=["foxglove.sdk.v1"]) as socket,
    ):
        assert json.loads(await socket.receive_str())["capabilities"] == ["time"]
        while len(channels) < len(read_topics()):
            for channel in json.loads(await socket.receive_str())["channels"]:
                channels[channel["topic"]] = channel
        channel = channels[topic]
        await socket.send_json({
            "op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]
        })
        while len(found) < number:
            frame = await socket.receive()
            if frame.type is aiohttp.WSMsgType.BINARY and frame.data[0] == MESSAGE:
                _, _, time_ns = HEAD.unpack_from(frame.data)
                (found[time_ns],) = NUMBER.unpack(frame.data[HEAD.size:])
    return channel, found


def test_a_client_receives_the_roofs_level_as_in_the_bag(domain: int, tmp_path: Path) -> None:
    """Ctrl-C ends the run, and the server with it."""
    run = Process(
        domain, "bringup", "--controller", "onoff", "--hours", "12", "--speed", "20",
        "--foxglove", "0", "--output", "run", "--namespace", "site1", cwd=tmp_path,
    )
    port = port_of(run.stderr)
    (server,) = children_of(run.process.pid)
    assert tcp_addresses_of(server) == {"0100007F"}
    channel, found = asyncio.run(receive(port, "/site1/roof/level", 40))
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "cdr", "std_msgs/msg/Float64", "ros2msg"
    )
    run.process.send_signal(signal.SIGINT)
    assert run.wait(120) == 130
    assert not alive(server)
    bag = recorded(tmp_path / "run")["/site1/roof/level"]
    for time_ns, value in found.items():  # at its tick, or at the one before or after it
        assert value in {each for at, each in bag.items() if abs(at - time_ns) <= 20e9}


def test_a_port_in_use_is_refused(unused_domain: int, tmp_path: Path) -> None:
    """Before anything starts; so is an option of the page."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for arguments, refusal in (
            (("bringup", "--foxglove", port), "cannot be used: Address already in use"),
            (("watch", "--foxglove", "--port", "8081"), "--port: applies only to the page"),
        ):
            done = run_command(*arguments, cwd=tmp_path, env=environment(unused_domain))
            assert done.returncode == 2 and refusal in done.stderr
    assert not (tmp_path / "runs").exists()
