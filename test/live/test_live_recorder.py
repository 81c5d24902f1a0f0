"""Which reports on /diagnostics the recorder of a live site keeps, by the test's own clock."""

from __future__ import annotations

import json

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message
from ros_rig import OK, WARN

from greenroof_ros.live.recorder import Recorded, shows_change


def report(
    *, node: str = "/pump", state: str = "ready", level: bytes = OK, code: str = "",
    fault: str = "12", sentence: str = "0.30 m3/h",
) -> bytes:
    """Return the report of a node with one part."""
    own = DiagnosticStatus(
        name=node, level=OK, message=state, values=[KeyValue(key="role", value=json.dumps("pump"))]
    )
    part = DiagnosticStatus(
        name=f"{node}: drive", level=level, message=sentence,
        values=[KeyValue(key="code", value=code), KeyValue(key="fault", value=fault)],
    )
    message: bytes = serialize_message(DiagnosticArray(status=[own, part]))
    return message


def test_reports_without_a_change_are_kept_every_ten_seconds_for_each_node() -> None:
    """Numbers, and sentences with numbers, are no change."""
    recorded: Recorded = {}
    kept = [
        (now, node)
        for now in range(30) for node in ("/pump", "/weather")
        if shows_change(report(node=node, sentence=f"{now} m3/h"), float(now), recorded)
    ]
    assert kept == [(now, node) for now in (0, 10, 20) for node in ("/pump", "/weather")]


@pytest.mark.parametrize("changed", [
    report(state="ended"), report(level=WARN), report(code="drive_local"), report(fault="14"),
], ids=["state", "level", "code", "fault"])
def test_each_change_is_kept(changed: bytes) -> None:
    """And so is its end."""
    recorded: Recorded = {}
    came = [report(), report(), changed, changed, report(), report()]
    kept = [
        shows_change(message, 0.25 * number, recorded) for number, message in enumerate(came)
    ]
    assert kept == [True, False, True, False, True, False]
