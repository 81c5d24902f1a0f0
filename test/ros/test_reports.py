"""What nodes last reported, from trusted and from hostile senders."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from page_inputs import STATUSES

from greenroof_ros.interface.alarm import ERROR, OK
from greenroof_ros.ros.reports import SILENT_S, Reports, Status


def said(name: str, *parts: Status, state: str = "ready", **values: Any) -> list[Status]:
    """Return the statuses of a node: its own, and those of its parts."""
    pairs = {"role": name.rpartition("/")[2], "process": "host 1", **values}
    texts = {key: json.dumps(value) for key, value in pairs.items()}
    return [Status(name, OK, state, texts), *parts]


def part(name: str, level: int, code: str, hardware: str = "", **values: str) -> Status:
    return Status(name, level, f"it is {code}", {"code": code, **values}, hardware)


def heard(*steps: tuple[float, list[Status]], namespace: str = "") -> Reports:
    """Return the reports of messages, each with its time."""
    reports = Reports(namespace)
    for at, statuses in steps:
        reports.receive(at, statuses)
    return reports


def found(reports: Reports, wall: float) -> dict[str, tuple[str, float]]:
    """Return the code and the beginning of what is wrong, by name."""
    return {name: (each.code, each.began) for name, each in reports.diagnoses(wall).items()}


FROST = part("/weather: frost", ERROR, "temperature_unknown")


def test_a_node_that_does_not_respond() -> None:
    """It is lost since its last report, and what it last reported stays."""
    reports = heard((0.0, said("/weather", FROST)))
    frost = {"/weather: frost": ("temperature_unknown", 0.0)}
    assert found(reports, SILENT_S) == frost
    assert found(reports, SILENT_S + 0.5) == {"/weather": ("node_silent", 0.0), **frost}
    assert reports.diagnoses(SILENT_S + 0.5)["/weather"].level == "stale"
    reports.receive(5.0, said("/weather"))
    assert not found(reports, 5.0)
    reports.excuse_silence(6.0)  # this process itself was paused
    assert not found(reports, 14.0)
    assert found(reports, 15.0) == {"/weather": ("node_silent", 11.0)}


def test_a_node_that_another_process_replaced() -> None:
    """It was lost since its last report, however soon it returned; what it reported is over."""
    other = said("/weather", process="host 2")
    reports = heard((0.0, said("/weather", FROST)), (0.5, other), (0.6, other))
    assert found(reports, 0.75) == {"/weather": ("node_silent", 0.0)}
    assert not found(reports, 1.75)
    assert not found(heard((0.0, said("/weather", state="ended")), (2.0, other)), 2.0)


def test_what_is_wrong_with_a_node() -> None:
    """It waits, or it has failed; one that ended as it was asked to is fine."""
    reports = heard((0.0, said("/weather", state="starting", waiting=["roof_sensor"])))
    (waits,) = reports.diagnoses(2.0).values()
    assert (waits.code, waits.level, waits.about) == ("peers_awaited", "warn", ("roof_sensor",))
    reports.receive(7.0, said("/weather", state="ended", failure="No space left"))
    (failed,) = reports.diagnoses(600.0).values()
    assert (failed.code, failed.level, failed.began) == ("node_failed", "error", 7.0)
    assert "No space left" in failed.sentence
    reports.receive(7.0, said("/weather", state="ended"))
    assert not found(reports, 600.0)


@pytest.mark.parametrize(("age", "began", "hardware", "line"), [
    ("12.5", 87.5, "mqtt://10.0.0.2:1883/roof/level", "10.0.0.2:1883"),
    ("nan", 100.0, "/dev/ttyS0, device 2", "/dev/ttyS0"),
    ("-1", 100.0, "gateway://[::1]:502,3", "[::1]:502"),
    ("x", 100.0, "a host", ""),
])
def test_a_part_reports_code_start_subject_and_line(
    age: str, began: float, hardware: str, line: str
) -> None:
    """What is no number of seconds is left out, and topics lose the namespace."""
    name = "/site1/pump: drive"
    topics = "/site1/roof/level /x"
    wrong = part(name, ERROR, "drive_fault", hardware, fault="2310", topics=topics, age_s=age)
    reports = heard(
        (0.0, said("/site1/pump", part(name, OK, ""))),
        *((at, said("/site1/pump", wrong)) for at in (100.0, 101.0)), namespace="/site1",
    )
    (drive,) = reports.diagnoses(101.0).values()
    assert (drive.code, drive.fault, drive.was_good) == ("drive_fault", "2310", True)
    assert (drive.about, drive.began, drive.line) == (("/roof/level", "/x"), began, line)


def test_the_start_of_a_site() -> None:
    """It lasts while all nodes are young; what never reports is awaited since then."""
    reports = Reports("/site1", ["pump", "mpc"])
    reports.receive(0.0, said("/site1/pump", up_s=59.0))
    assert reports.is_starting(1.0) and not reports.is_starting(60.0)  # silent
    assert found(reports, 3.0) == {"/site1/mpc": ("node_awaited", 3.0)}
    assert reports.diagnoses(3.0)["/site1/mpc"].role == "controller"
    reports.receive(1.0, said("/site1/weather", up_s=61.0))
    assert not reports.is_starting(1.0)


def test_forged_nodes_take_little_room() -> None:
    """Other devices and other graphs take none."""
    reports = heard((0.0, said("/pump")))
    for number in range(1000):
        for role in ("pump", "weather", f"role {number}"):
            reports.receive(1.0, said(f"/{role}{number}", role=role, process=f"host {number}"))
    assert len(reports.nodes) < 40
    reports.receive(2.0, said("/pump", role="weather"))  # of the same name
    assert reports.nodes["/pump"].role == "pump"
    for name in ("pump", "/1", "/" + "p" * 300, "/x: y", "/site2/pump"):
        others = heard((0.0, [*said(name, role="pump"), part("/camera", ERROR, "no picture")]))
        assert not others.nodes and not found(others, 9.0)


def test_the_time_of_a_run_is_its_plants_after_the_first_tick() -> None:
    """Before, a node stamps with the system's time; no other node has a say."""
    reports = Reports()
    for tick, role, stamp_ns, known in (
        (0, "plant", 5, 0), (1, "controller", 5, 0), (1, "plant", 7, 7), (2, "plant", 2**62, 7),
    ):
        reports.receive(0.0, said(f"/{role}", tick=tick), stamp_ns)
        assert reports.time_ns == known


# --- hostile messages -----------------------------------------------------------------------------

@settings(max_examples=100)
@given(st.lists(STATUSES, max_size=4))
def test_nothing_that_is_reported_raises(messages: list[list[Status]]) -> None:
    """And every name and sentence can be printed."""
    reports = Reports("", ["pump"])
    for wall, statuses in enumerate(messages):
        reports.receive(wall, statuses)
        reports.is_starting(wall)
        reports.value("cistern_level")
        for name, diagnosis in reports.diagnoses(wall).items():
            text = f"{name} {diagnosis.sentence} {diagnosis.about} {diagnosis.line}"
            text.encode()
            assert text.isprintable() and len(diagnosis.sentence) < 2000
