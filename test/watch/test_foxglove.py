"""``--foxglove`` as processes: a client over a WebSocket, as Foxglove and Lichtblick are.

For a live site see test_bridge.py.
"""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import struct
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import Process, alive, environment, wait_for
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_watch_command import tcp_addresses_of

from greenroof_ros.interface.topics import read_topics

pytest.importorskip("aiohttp", reason="the client uses it")
pytest.importorskip("foxglove", reason="serves Foxglove")
pytest.importorskip("rclpy", reason="nodes need ROS 2")

import aiohttp
from test_feed import recorded

LEVEL = "/roof/level"
URL = re.compile(r"ws://127\.0\.0\.1:(\d+)\n")
# Kinds of binary frames, and what is before a message: its subscription and its time.
MESSAGE, TIME = 1, 2
HEAD = struct.Struct("<BIQ")


def port_of(read: Callable[[], str]) -> int:
    """Wait for the address that a process prints, and return its port."""
    return int(wait_for(lambda: URL.search(read()), 60, "an address")[1])


@asynccontextmanager
async def client(port: int) -> AsyncIterator[tuple[Any, dict[str, dict[str, Any]]]]:
    """Connect as a viewer does; yield the connection and the advertised channels by topic."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{port}", protocols=["foxglove.sdk.v1"]) as connection,
    ):
        assert connection.protocol == "foxglove.sdk.v1"
        information = json.loads(await connection.receive_str())
        assert information["op"] == "serverInfo" and information["capabilities"] == ["time"]
        channels: dict[str, dict[str, Any]] = {}
        while len(channels) < len(read_topics()):
            advertised = json.loads(await connection.receive_str())
            assert advertised["op"] == "advertise"
            channels.update({channel["topic"]: channel for channel in advertised["channels"]})
        yield connection, channels


async def subscribe(connection: Any, *channels: dict[str, Any]) -> None:
    await connection.send_json({"op": "subscribe", "subscriptions": [
        {"id": channel["id"], "channelId": channel["id"]} for channel in channels
    ]})


def receive(port: int, topic: str, number: int) -> tuple[dict[str, Any], list[tuple[int, float]]]:
    """Subscribe to a number; return its channel and some values, each with its time (ns)."""
    found: list[tuple[int, float]] = []

    async def run() -> dict[str, Any]:
        async with client(port) as (connection, channels):
            channel = channels[topic]
            types = get_typestore(Stores.EMPTY)
            types.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
            await subscribe(connection, channel)
            newest = [0]
            while len(found) < number:
                frame = await connection.receive()
                if frame.type is aiohttp.WSMsgType.BINARY and frame.data[0] == TIME:
                    newest += struct.unpack_from("<Q", frame.data, 1)
                elif frame.type is aiohttp.WSMsgType.BINARY:
                    kind, subscription, time_ns = HEAD.unpack_from(frame.data)
                    assert (kind, subscription) == (MESSAGE, channel["id"])
                    message = types.deserialize_cdr(frame.data[HEAD.size:], channel["schemaName"])
                    found.append((time_ns, message.data))
            # The server sends the time in a queue of its own, so that it may be behind by a little.
            assert newest == sorted(newest) and found[0][0] < newest[-1] <= found[-1][0] + 10**9
            return channel

    return asyncio.run(asyncio.wait_for(run(), 120)), found


@contextmanager
def deaf_client(port: int) -> Iterator[None]:
    """Subscribe to everything, and never read again."""
    ready, done = threading.Event(), threading.Event()

    async def run() -> None:
        async with client(port) as (connection, channels):
            await subscribe(connection, *channels.values())
            ready.set()
            await asyncio.to_thread(done.wait)

    thread = threading.Thread(target=lambda: asyncio.run(run()))
    thread.start()
    try:
        assert ready.wait(60)
        yield
    finally:
        done.set()
        thread.join(60)


def test_a_client_receives_the_roofs_level_as_in_the_bag(domain: int, tmp_path: Path) -> None:
    """Each value at its tick's simulated time; Ctrl-C ends the run, and the server with it."""
    run = Process(
        domain, "bringup", "--controller", "onoff", "--hours", "12", "--speed", "20",
        "--foxglove", "0", "--output", "run", "--namespace", "site1", cwd=tmp_path,
    )
    port = port_of(run.stderr)
    children = Path(f"/proc/{run.process.pid}/task/{run.process.pid}/children")
    (server,) = map(int, children.read_text().split())
    assert tcp_addresses_of(server) == {"0100007F"}
    channel, found = receive(port, f"/site1{LEVEL}", 40)
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "cdr", "std_msgs/msg/Float64", "ros2msg"
    )
    run.process.send_signal(signal.SIGINT)
    assert run.wait(120) == 130
    assert not alive(server)
    messages = recorded(tmp_path / "run")[f"/site1{LEVEL}"]
    values = {time_ns: struct.unpack("<4xd", data)[0] for time_ns, data in messages.items()}
    assert [value for _, value in found] == [values[time_ns] for time_ns, _ in found]
    assert len({time_ns for time_ns, _ in found}) == 40


def test_a_port_in_use_is_refused(unused_domain: int, tmp_path: Path) -> None:
    """Before anything starts; so is an option of the page."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        done = run_command(
            "bringup", "--foxglove", port, cwd=tmp_path, env=environment(unused_domain)
        )
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        2, f"error: --foxglove = '{port}': this port cannot be used: Address already in use; "
        "choose another port"
    )
    assert not (tmp_path / "runs").exists()
    done = run_command(
        "watch", "--foxglove", "--port", "8081", cwd=tmp_path, env=environment(unused_domain)
    )
    assert (done.returncode, done.stderr) == (
        2, "error: --port: applies only to the page; omit this option or --foxglove\n"
    )


