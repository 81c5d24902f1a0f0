"""What nodes and other devices last reported, from trusted and from hostile senders."""

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
from greenroof_ros.ros.reports import SILENT_S, NodeReport, Reports, Status, read_statuses

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
    assert (lost.code, lost.since, lost.level) == ("not_heard", NOON, STALE)
    assert found["/weather: frost"].code == "temperature_unknown"
    reports.receive(5.0, NOON + 5, said("/weather"))
    assert codes(reports, 5.0) == {"/weather: frost": "not_heard"}  # it no longer mentions it


def test_a_node_that_another_process_replaced() -> None:
    """It was lost since its last report, however soon it returned; what it reported is over."""
    wrong = said("/weather", "", ("frost", ERROR, "temperature_unknown"))
    reports = heard((0.0, wrong), (2.0, said("/weather", process="host 2")))
    (lost,) = reports.diagnoses(2.25).values()
    assert (lost.code, lost.since, lost.age_s) == ("not_heard", NOON, 2.25)
    reports.receive(3.0, NOON + 3, said("/weather", process="host 2"))
    assert not codes(reports, 3.0)
    ended = heard((0.0, said("/weather", state="ended")), (2.0, said("/weather", process="host 2")))
    assert not codes(ended, 2.0)


def test_what_is_wrong_with_a_node() -> None:
    reports = heard((0.0, said("/weather", state="starting", waiting=["roof_sensor"])))
    (waits,) = reports.diagnoses(2.0).values()
    assert (waits.code, waits.about, waits.age_s) == ("peers_awaited", ("roof_sensor",), 2.0)
    for at in (3.0, 3.5):
        reports.receive(at, NOON, said("/weather", refused={"/a": 7}))
    assert codes(reports, 3.5) == {"/weather: refused": "values_refused"}
    assert codes(reports, 6.9) == {}
    reports.receive(7.0, NOON, said("/weather", state="ended"))  # as it was asked to
    assert codes(reports, 600.0) == {}
    reports.receive(7.5, NOON, said("/weather", state="ended", failure="No space left on device"))
    (failed,) = reports.diagnoses(600.0).values()
    assert (failed.code, failed.level) == ("node_failed", ERROR)
    assert "No space left" in failed.sentence


def test_a_part_reports_code_start_age_subject_and_line() -> None:
    """What is no number or time is left out, and topics lose the namespace."""
    for values, since, age in (
        ({"since": "2027-01-15T08:00:00.000+00:00", "age_s": "12.5"}, NOON, 12.5),
        ({"since": "yesterday", "age_s": "nan"}, None, 0.0), ({"age_s": "-1"}, None, 0.0),
    ):
        more = {"fault": "2310", "topics": "/site1/roof/level /x", **values}
        reports = heard(
            (0.0, said("/site1/pump", "", ("drive", OK, ""))),
            (0.1, said("/site1/pump", "", ("drive", ERROR, "drive_fault", more))),
            namespace="/site1",
        )
        (found,) = reports.diagnoses(0.1).values()
        assert (found.code, found.fault, found.was_good) == ("drive_fault", "2310", True)
        assert (found.about, found.since, found.age_s) == (("/roof/level", "/x"), since, age)
    for hardware, line in (
        ("mqtt://10.0.0.2:1883/roof/level", "10.0.0.2:1883"), ("shelly, mqtt://b/x", "b"),
        ("tcp://10.0.0.3:502, device 1", "10.0.0.3:502"), ("/dev/ttyS0, device 2", "/dev/ttyS0"),
        ("gateway://[::1]:502,3", "[::1]:502"), ("a host", ""),
    ):
        node = NodeReport("/pump", "pump")
        node.receive_part("drive", 0.0, Status("/pump: drive", ERROR, "bad", {}, hardware))
        assert node.parts["drive"].line == line


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
    (awaited,) = reports.diagnoses(0.0).items()
    assert (awaited[0], awaited[1].code, awaited[1].role) == (
        "/site1/mpc", "node_awaited", "controller"
    )


def test_two_processes_of_one_name() -> None:
    """A restart is none, nor is one that reports no more; a copy of a process is known, too."""
    reports = Reports()
    for at in (0.0, 0.5, 1.0):
        reports.receive(at, NOON, said("/pump", process="host 2" if at else "host 1"))
        assert not codes(reports, at)
    for step in range(8):
        reports.receive(1.5 + step / 4, NOON, said("/pump", process=f"host {step % 2 + 1}"))
    (twins,) = reports.diagnoses(3.5).values()
    assert twins.sentence == "two processes report under this name: host 1 and host 2"
    for at in (4.0, 5.0, 6.0, 7.0):
        reports.receive(at, NOON, said("/pump", process="host 2"))
    assert not codes(reports, 7.0)
    copied = Reports()
    for at, up, two in ((0.0, 7.0, False), (1.0, 9.0, False), (1.2, 1.0, True), (2.0, 10.0, True),
                        (4.0, 12.0, True), (5.0, 13.0, False)):
        copied.receive(at, NOON, said("/pump", up_s=up))
        assert (codes(copied, at) == {"/pump": "two_processes"}) == two, at


def test_processes_that_report_once_hide_no_other() -> None:
    reports = Reports()
    for step in range(50):
        at = step / 10
        process = "host 1" if step % 10 == 0 else f"forged {step}"
        reports.receive(at, NOON, said("/pump", process=process))
        assert (codes(reports, at) == {"/pump": "two_processes"}) == (step >= 10)


def test_two_pump_nodes() -> None:
    """In this namespace; a silent one is missed for 10 s, until the other is taken for it."""
    reports = heard((0.0, said("/pump")), (0.0, said("/other/pump")))
    assert not codes(reports, 0.0)
    reports.receive(0.0, NOON, said("/forged", "pump"))
    assert codes(reports, 0.0) == {"/forged: pump nodes": "two_pump_nodes"}
    for at in range(1, 11):
        reports.receive(at, NOON, said("/pump"))
    assert codes(reports, 9.0) == {"/forged": "not_heard"}
    assert not codes(reports, 10.1)


def test_forged_nodes_take_no_room_from_others() -> None:
    reports = heard((0.0, said("/pump")))
    for number in range(1000):
        for role in ("pump", "weather", f"role {number}"):
            reports.receive(1.0, NOON, said(f"/{role}{number}", role, process=f"host {number}"))
    reports.receive(2.0, NOON, said("/pump", "weather"))  # of the same name
    reports.receive(2.0, NOON, said("/mpc", "controller"))
    assert {"/pump", "/mpc"} <= reports.nodes.keys() and len(reports.nodes) < 20
    assert reports.nodes["/pump"].role == "pump"
    for name in ("pump", "/1", "/" + "p" * 300, "/x: y"):  # what ROS lets no node be called
        assert name not in heard((0.0, said(name, "pump"))).nodes


def test_the_time_of_a_run_is_its_plants_after_the_first_tick() -> None:
    """Before, a node stamps with the system's time; no other node has a say."""
    reports = Reports()
    for tick, role, stamp_ns, known in (
        (0, "plant", 5, 0), (1, "controller", 5, 0), (1, "plant", 7, 7), (2, "plant", 2**62, 7),
    ):
        reports.receive(0.0, NOON, said(f"/{role}", role, tick=tick), stamp_ns)
        assert reports.time_ns == known


def test_other_devices() -> None:
    """They have 5 s; a device received only once is not missed; a graph's end is no loss."""
    once, often = Status("/camera", OK, "fine"), Status("disk usage", ERROR, "99 %")
    reports = heard((0.0, [once, often]), (1.0, [often]))
    for wall, what in ((5.9, "99 %"), (6.1, "no message for 5 s")):
        (found,) = reports.diagnoses(wall).values()
        assert (found.sentence, found.role, found.code) == (what, "", "")
    there = heard(
        *((at, [*said("/site2/mpc", "controller"), *said("/site2/pump")]) for at in (0.0, 1.0)),
        (2.0, said("/site2/mpc", "controller", state="ended")), namespace="/site1",
    )
    assert there.diagnoses(7.1).keys() == {"/site2/pump"}


def test_a_pause_of_this_process_is_no_silence_of_others() -> None:
    reports = heard((0.0, [*said("/pump"), *said("/mpc", "controller")]))
    reports.excuse_silence(6.0)
    reports.receive(6.0, NOON, said("/mpc", "controller"))  # the first of the waiting messages
    assert not codes(reports, 6.0)
    assert codes(reports, 10.0).keys() == {"/pump", "/mpc"}


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
            assert text.isprintable() and len(diagnosis.sentence) < 1200


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
