"""The heartbeat of a process with several nodes, and with a bringup that does not read."""

from __future__ import annotations

import os

import pytest

from greenroof_ros.live import heartbeat
from greenroof_ros.live.heartbeat import NOT_REQUIRED, PIPE, Beat, send_beat


def test_a_heartbeat_is_of_all_nodes_of_a_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is ready when all are; a full or a closed pipe stops no one."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    monkeypatch.setenv(PIPE, str(writing))
    monkeypatch.setattr(heartbeat, "states", {"weather": Beat(0), "pump": Beat(0)})
    for node, state, beat in (
        ("pump", Beat.READY | Beat.AT_REST, Beat.AT_REST), ("weather", Beat.READY, Beat(3)),
        ("pump", Beat.READY | Beat.REACHED, Beat(5)), ("pump", Beat(0), Beat(0)),
    ):
        send_beat(node, state)
        assert os.read(reading, 10) == bytes([beat])
    for _ in range(100_000):
        send_beat("pump", Beat.READY)
    os.close(reading)
    send_beat("pump", Beat.READY)
    os.close(writing)
    assert {"recorder", "rain_gauge"} < NOT_REQUIRED and "roof_sensor" not in NOT_REQUIRED
