"""What nodes last reported, from trusted and from hostile senders."""

from __future__ import annotations

import json
from collections.abc import Callable
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from greenroof_ros.interface.alarm import ERROR, OK, STALE, WARN
from greenroof_ros.ros.reports import SILENT_S, Reports, Status, read_statuses

NOON = 1_800_000_000.0
STORE = get_typestore(Stores.ROS2_JAZZY)


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


def test_a_part_reports_code_start_age_subject_and_line() -> None:
    """What is no number of seconds is left out, and topics lose the namespace."""
    for at, age, began in ((100.0, "12.5", 87.5), (100.0, "nan", 100.0), (100.0, "-1", 100.0)):
        more = {"fault": "2310", "topics": "/site1/roof/level /x", "age_s": age}
        wrong = said("/site1/pump", "", ("drive", ERROR, "drive_fault", more))
        reports = heard(
            (0.0, said("/site1/pump", "", ("drive", OK, ""))), (at, wrong), (at + 1.0, wrong),
            namespace="/site1",
        )
        (found,) = reports.diagnoses(at + 1.0).values()
        assert (found.code, found.fault, found.was_good) == ("drive_fault", "2310", True)
        assert found.about == ("/roof/level", "/x")
        assert (found.began, found.since) == (began, NOON + began)
    for hardware, line in (
        ("mqtt://10.0.0.2:1883/roof/level", "10.0.0.2:1883"), ("shelly, mqtt://b/x", "b"),
        ("tcp://10.0.0.3:502, device 1", "10.0.0.3:502"), ("/dev/ttyS0, device 2", "/dev/ttyS0"),
        ("gateway://[::1]:502,3", "[::1]:502"), ("a host", ""),
    ):
        reports = heard((0.0, [*said("/pump"), Status("/pump: drive", ERROR, "", {}, hardware)]))
        assert reports.diagnoses(0.0)["/pump: drive"].line == line


def test_a_site_starts_while_all_its_nodes_are_young() -> None:
    assert heard((0.0, said("/pump", up_s=59.0))).is_starting(1.0)
    assert not heard((0.0, said("/pump", up_s=59.0))).is_starting(60.0)  # silent
    for other in ({"up_s": 61.0}, {}):
        both = heard((0.0, said("/pump", up_s=59.0)), (0.0, said("/weather", **other)))
        assert not both.is_starting(1.0)
    assert not Reports().is_starting(1.0)


def test_a_node_that_never_reports_is_awaited() -> None:
    reports = Reports("/site1", ["pump", "mpc"])
    reports.receive(0.0, NOON, said("/site1/pump"))
    (awaited,) = reports.diagnoses(3.0).items()
    assert (awaited[0], awaited[1].code, awaited[1].role) == (
        "/site1/mpc", "node_awaited", "controller"
    )
    assert reports.diagnoses(9.0)["/site1/mpc"].began == 3.0


def test_forged_nodes_take_no_room_from_others() -> None:
    """Nor do other devices and other graphs."""
    reports = heard((0.0, said("/pump")))
    for number in range(1000):
        for role in ("pump", "weather", f"role {number}"):
            reports.receive(1.0, NOON, said(f"/{role}{number}", role, process=f"host {number}"))
    assert "/pump" in reports.nodes and len(reports.nodes) < 40
    reports.receive(2.0, NOON, said("/pump", "weather"))  # of the same name
    assert reports.nodes["/pump"].role == "pump"
    reports.receive(9.0, NOON, said("/mpc", "controller"))
    assert "/mpc" in reports.nodes
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
        reports.level("cistern")
        for name, diagnosis in reports.diagnoses(wall).items():
            text = f"{name} {diagnosis.sentence} {diagnosis.about} {diagnosis.line}"
            text.encode()
            assert text.isprintable() and len(diagnosis.sentence) < 2000


def made(name: str, *fields: Any) -> Any:
    package, _, kind = name.partition("/")
    return STORE.types[f"{package}/msg/{kind}"](*fields)


def written(*statuses: tuple[Any, ...]) -> bytes:
    """Return an array with these statuses, in CDR as rosbags writes it."""
    header = made("std_msgs/Header", made("builtin_interfaces/Time", 1_700_000_000, 5), "frame")
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    return bytes(STORE.serialize_cdr(made("diagnostic_msgs/DiagnosticArray", header, [
        made("diagnostic_msgs/DiagnosticStatus", *status) for status in statuses
    ]), kind))


def pair(key: str, value: str) -> Any:
    return made("diagnostic_msgs/KeyValue", key, value)


def test_messages_are_read_as_written_and_hostile_ones_are_cut() -> None:
    """Ten thousand statuses, a text of a megabyte, a thousand values."""
    message = written(
        (0, "/plant", "ready", "machine", [pair("role", '"plant"')]),
        (3, "/pump: drive", "ü <b>", "", []),
    )
    assert read_statuses(message) == (1_700_000_000_000_000_005, [
        Status("/plant", 0, "ready", {"role": '"plant"'}, "machine"),
        Status("/pump: drive", 3, "ü <b>"),
    ])
    pairs = [pair(str(n), "v" * 30_000 * (n < 2)) for n in range(1000)]
    _, read = read_statuses(written(
        (9, "/x", "m" * 1_000_000, "", pairs), *[(2, "/y", "", "", [])] * 9_999
    ))
    assert (len(read), read[0].level, len(read[0].message)) == (1000, 2, 20_000)
    assert (len(read[0].values), len(read[0].values["1"])) == (100, 20_000)


@pytest.mark.parametrize("change", [
    lambda message, random: message[: random.randrange(len(message) - 4)],
    lambda message, random: bytes(
        random.choice((0, 1, 127, 255)) if random.random() < 0.02 else byte for byte in message
    ),
    lambda message, random: message + b"\0" * 8_000_001,
])
def test_what_is_not_whole_is_read_or_refused(change: Callable[[bytes, Random], bytes]) -> None:
    """The node counts and drops what is refused; it never ends."""
    message = written((0, "/plant", "ready", "machine", [pair("role", '"plant"')]))
    random = Random(1)
    for _ in range(300):
        try:
            _, statuses = read_statuses(change(message, random))
        except Exception:
            continue
        Reports().receive(0.0, NOON, statuses)
