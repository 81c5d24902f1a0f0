"""What nodes last reported, from trusted and from hostile senders."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greenroof_ros.interface.alarm import ERROR, OK, STALE, WARN
from greenroof_ros.ros.errors import MalformedMessageError
from greenroof_ros.ros.reports import SILENT_S, Reports, Status, read_statuses

NOON = 1_800_000_000.0


def said(
    name: str, role: str = "", *parts: tuple[Any, ...], process: str = "host 1",
    state: str = "ready", **values: Any,
) -> list[Status]:
    """Return the statuses of a node: its own, and those of parts (part, level, code, values)."""
    pairs = {"role": role or name.rpartition("/")[2], "process": process, **values}
    return [
        Status(name, OK, state, {key: json.dumps(value) for key, value in pairs.items()}),
        *(Status(f"{name}: {part}", level, f"it is {code}", {"code": code, **dict(*more)})
          for part, level, code, *more in parts),
    ]


def codes(reports: Reports, wall: float) -> dict[str, str]:
    return {name: diagnosis.code for name, diagnosis in reports.diagnoses(wall).items()}


def heard(*steps: tuple[float, list[Status]], namespace: str = "") -> Reports:
    """Return the reports of messages, each with its time."""
    reports = Reports(namespace)
    for at, statuses in steps:
        reports.receive(at, NOON + at, statuses)
    return reports


def test_a_node_that_does_not_respond() -> None:
    """It is lost since its last report, and what it last reported stays."""
    reports = heard((0.0, said("/weather", "", ("frost", ERROR, "temperature_unknown"))))
    assert codes(reports, SILENT_S) == {"/weather: frost": "temperature_unknown"}
    found = reports.diagnoses(SILENT_S + 0.5)
    lost = found["/weather"]
    assert (lost.code, lost.since, lost.began, lost.level) == ("not_heard", NOON, 0.0, "stale")
    assert found["/weather: frost"].code == "temperature_unknown"
    reports.receive(5.0, NOON + 5, said("/weather"))
    assert not codes(reports, 5.0)
    reports.excuse_silence(6.0)  # this process itself was paused
    assert not codes(reports, 14.0)
    assert codes(reports, 15.0) == {"/weather": "not_heard"}


def test_a_node_that_another_process_replaced() -> None:
    """It was lost since its last report, however soon it returned; what it reported is over."""
    wrong = said("/weather", "", ("frost", ERROR, "temperature_unknown"))
    reports = heard((0.0, wrong), (0.5, said("/weather", process="host 2")))
    reports.receive(0.6, NOON, said("/weather", process="host 2"))
    (lost,) = reports.diagnoses(0.75).values()
    assert (lost.code, lost.since, lost.began) == ("not_heard", NOON, 0.0)
    assert not codes(reports, 1.75)
    ended = heard((0.0, said("/weather", state="ended")), (2.0, said("/weather", process="host 2")))
    assert not codes(ended, 2.0)


def test_what_is_wrong_with_a_node() -> None:
    reports = heard((0.0, said("/weather", state="starting", waiting=["roof_sensor"])))
    (waits,) = reports.diagnoses(2.0).values()
    assert (waits.code, waits.about, waits.began) == ("peers_awaited", ("roof_sensor",), 0.0)
    reports.receive(7.0, NOON, said("/weather", state="ended"))  # as it was asked to
    assert codes(reports, 600.0) == {}
    reports.receive(7.5, NOON, said("/weather", state="ended", failure="No space left on device"))
    (failed,) = reports.diagnoses(600.0).values()
    assert (failed.code, failed.level) == ("node_failed", "error")
    assert "No space left" in failed.sentence


@pytest.mark.parametrize(("age", "began"), [("12.5", 87.5), ("nan", 100.0), ("-1", 100.0)])
def test_a_part_reports_code_start_and_subject(age: str, began: float) -> None:
    """What is no number of seconds is left out, and topics lose the namespace."""
    more = {"fault": "2310", "topics": "/site1/roof/level /x", "age_s": age}
    wrong = said("/site1/pump", "", ("drive", ERROR, "drive_fault", more))
    reports = heard(
        (0.0, said("/site1/pump", "", ("drive", OK, ""))), (100.0, wrong), (101.0, wrong),
        namespace="/site1",
    )
    (found,) = reports.diagnoses(101.0).values()
    assert (found.code, found.fault, found.was_good) == ("drive_fault", "2310", True)
    assert found.about == ("/roof/level", "/x")
    assert (found.began, found.since) == (began, NOON + began)


@pytest.mark.parametrize(("hardware", "line"), [
    ("mqtt://10.0.0.2:1883/roof/level", "10.0.0.2:1883"), ("/dev/ttyS0, device 2", "/dev/ttyS0"),
    ("gateway://[::1]:502,3", "[::1]:502"), ("a host", ""),
])
def test_the_line_of_a_device(hardware: str, line: str) -> None:
    reports = heard((0.0, [*said("/pump"), Status("/pump: drive", ERROR, "", {}, hardware)]))
    assert reports.diagnoses(0.0)["/pump: drive"].line == line


def test_the_start_of_a_site() -> None:
    """It lasts while all nodes are young; what never reports is awaited since then."""
    reports = Reports("/site1", ["pump", "mpc"])
    reports.receive(0.0, NOON, said("/site1/pump", up_s=59.0))
    assert reports.is_starting(1.0) and not reports.is_starting(60.0)  # silent
    (awaited,) = reports.diagnoses(3.0).values()
    assert (awaited.name, awaited.code, awaited.role, awaited.began) == (
        "/site1/mpc", "node_awaited", "controller", 3.0
    )
    reports.receive(1.0, NOON, said("/site1/weather", up_s=61.0))
    assert not reports.is_starting(1.0)


def test_forged_nodes_take_little_room() -> None:
    """Other devices and other graphs take none."""
    reports = heard((0.0, said("/pump")))
    for number in range(1000):
        for role in ("pump", "weather", f"role {number}"):
            reports.receive(1.0, NOON, said(f"/{role}{number}", role, process=f"host {number}"))
    assert "/pump" in reports.nodes and len(reports.nodes) < 40
    reports.receive(2.0, NOON, said("/pump", "weather"))  # of the same name
    assert reports.nodes["/pump"].role == "pump"
    for name in ("pump", "/1", "/" + "p" * 300, "/x: y", "/site2/pump"):
        others = heard((0.0, [*said(name, "pump"), Status("/camera", ERROR, "no picture")]))
        assert not others.nodes and not codes(others, 9.0)


def test_the_time_of_a_run_is_its_plants_after_the_first_tick() -> None:
    """Before, a node stamps with the system's time; no other node has a say."""
    reports = Reports()
    for tick, role, stamp_ns, known in (
        (0, "plant", 5, 0), (1, "controller", 5, 0), (1, "plant", 7, 7), (2, "plant", 2**62, 7),
    ):
        reports.receive(0.0, NOON, said(f"/{role}", role, tick=tick), stamp_ns)
        assert reports.time_ns == known


# --- hostile messages -----------------------------------------------------------------------------

_TEXTS = st.one_of(
    st.text(max_size=30),
    st.sampled_from([
        "/pump", "/pump: drive", "/mpc: inputs", "ready", "ended", "starting", "", ": ", "/",
        "<script>alert(1)</script>", "\ud800\x00\u202e", "[" * 2000, "9" * 401, "1e999", "NaN",
        '"pump"', '"controller"', "{}", "[[1]]", '["x"]', '{"/a": 1}', '{"/a": 9' + "9" * 400 + "}",
        '[{"parameter": [[]], "value": {}}]', "null", "true", "-Infinity", "mqtt://\u202e/x",
    ]),
)
_STATUSES = st.builds(
    Status, _TEXTS, st.sampled_from([OK, WARN, ERROR, STALE]), _TEXTS,
    st.dictionaries(
        st.sampled_from([
            "role", "process", "refused", "waiting", "failure", "up_s", "tick", "topics", "code",
            "since", "age_s", "cistern_level",
        ]) | _TEXTS, _TEXTS, max_size=8,
    ), _TEXTS,
)


@settings(max_examples=100)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.1, 3.0]), st.lists(_STATUSES, max_size=4)),
                max_size=4))
def test_nothing_that_is_reported_raises(messages: list[tuple[float, list[Status]]]) -> None:
    """And every name and sentence can be printed."""
    reports, wall = Reports("", ["pump"]), 0.0
    for passed, statuses in messages:
        wall += passed
        reports.receive(wall, NOON, statuses)
        reports.is_starting(wall)
        reports.value("cistern_level")
        for name, diagnosis in reports.diagnoses(wall).items():
            text = f"{name} {diagnosis.sentence} {diagnosis.about} {diagnosis.line}"
            text.encode()
            assert text.isprintable() and len(diagnosis.sentence) < 2000


def test_messages_are_read_as_written_or_dropped() -> None:
    pytest.importorskip("rclpy")
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rclpy.serialization import serialize_message

    def read(*statuses: Any) -> list[Status]:
        array = DiagnosticArray(status=statuses)
        array.header.stamp.sec, array.header.stamp.nanosec = 1_700_000_000, 5
        time_ns, found = read_statuses(serialize_message(array))
        assert time_ns == 1_700_000_000_000_000_005
        return found

    plant = DiagnosticStatus(name="/plant", message="ü <b>", hardware_id="machine", values=[
        KeyValue(key="role", value='"plant"'),
    ])
    assert read(plant) == [Status("/plant", 0, "ü <b>", {"role": '"plant"'}, "machine")]
    (worst,) = read(DiagnosticStatus(level=b"\x09", name="/x"))
    assert worst.level == ERROR
    for message in (b"", b"\0\1\0\0abc", b"\0" * 1_000_001):  # counted, and dropped
        with pytest.raises(MalformedMessageError):
            read_statuses(message)
