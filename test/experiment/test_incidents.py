"""What is treated as an incident, from nodes' reports on their parts; and how it is read back."""

from __future__ import annotations

import json
import re
import time
import tracemalloc
from dataclasses import asdict
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from greenroof_ros.common.disk import DISK
from greenroof_ros.experiment import incidents
from greenroof_ros.experiment.incidents import (
    INCIDENTS,
    Incident,
    IncidentLog,
    read_incidents,
    with_incidents,
)


def report_of(node: str, code: str = "a_code", **parts: str) -> dict[str, dict[str, Any]]:
    """Return a node's report with these parts, each at a level with a reason."""
    diagnoses = {
        part: {"level": level, "message": f"{part} {level}", "code": "" if level == "OK" else code}
        for part, level in parts.items()
    }
    return {node: {"diagnoses": diagnoses}}


def test_every_part_of_a_node_has_a_rule_or_none_on_purpose() -> None:
    """These parts change nothing, or another part is lost with them."""
    package = Path(incidents.__file__).parents[1]
    text = "".join(file.read_text() for file in (package / "live").glob("*.py"))
    parts = set(re.findall(r'diagnose(?:_gauge)?\(\s*"([a-z ]+)"', text))
    assert {"drive", "forecast", "rain gauge"} < parts
    assert {"levels", "frost", "command"} <= incidents._RULES.keys()
    assert parts - incidents._RULES.keys() == {
        "delivery", "dose", "drive file", "drive timeout", "forecast service", "limits",
    }


def test_a_loss_and_its_return(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With ticks and wall time, written at each change; a present incident has no end."""
    now = datetime(2026, 11, 23, 20, 0, tzinfo=timezone.utc)
    monkeypatch.setattr(incidents, "wall_time", lambda: now.isoformat())
    messages: list[str] = []
    log = IncidentLog(messages.append, tmp_path / INCIDENTS)
    log.update(report_of("pump", drive="OK"), 1)
    assert log.count == 0
    assert read_incidents(tmp_path) == []
    log.update(report_of("pump", drive="ERROR"), 5)
    log.update(report_of("pump", drive="ERROR"), 6)
    assert DISK.wait(60)
    (lasting,) = read_incidents(tmp_path)
    assert (lasting.number, lasting.node, lasting.part, lasting.cause, lasting.code) == (
        1, "pump", "drive", "drive ERROR", "a_code"
    )
    assert (lasting.began_tick, lasting.ended_tick, lasting.ended, lasting.seconds) == (
        5, None, None, None
    )
    now += timedelta(seconds=0.2)
    log.update(report_of("pump", drive="OK"), 9)
    log.update(report_of("pump", drive="ERROR"), 11)
    assert DISK.wait(60)
    ended, again = read_incidents(tmp_path)
    assert (ended.number, ended.began, ended.ended_tick) == (1, lasting.began, 9)
    assert ended.seconds == 0.2
    assert (again.number, again.began_tick, again.ended) == (2, 11, None)
    assert log.as_dicts() == [asdict(ended), asdict(again)]
    assert (log.count, log.lasting) == (2, True)
    assert messages[0] == "incident 1 at tick 5: pump: drive ERROR"
    assert messages[1].startswith("incident 1 is over at tick 9, after 0.2 s")
    assert messages[2] == "incident 2 at tick 11: pump: drive ERROR"


@pytest.mark.parametrize(
    ("part", "level", "counts"),
    [
        ("drive", "ERROR", True), ("drive", "STALE", True), ("drive", "WARN", False),
        ("pump", "ERROR", True), ("pump", "WARN", False), ("recording", "ERROR", True),
        ("limits", "WARN", False), ("frost", "ERROR", False), ("sensor", "ERROR", False),
    ],
)
def test_what_counts_at_once(part: str, level: str, counts: bool) -> None:
    """A pump that is held, frost and limits are not losses; a sensor may miss one reading."""
    log = IncidentLog(lambda _: None)
    log.update(report_of("node", **{part: level}))
    assert log.count == counts


def test_a_sensor_is_lost_after_three_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is then lost since the start; a reading in between restarts the time."""
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    log = IncidentLog(lambda _: None)
    for at, level, count in (
        (100.0, "ERROR", 0), (102.9, "ERROR", 0), (103.0, "OK", 0), (104.0, "ERROR", 0),
        (106.9, "ERROR", 0), (107.0, "ERROR", 1), (120.0, "ERROR", 1),
    ):
        now = at
        log.update(report_of("roof_sensor", sensor=level))
        assert log.count == count, at


@pytest.mark.parametrize(
    ("loss", "end", "consequence"),
    [
        (
            report_of("roof_sensor", sensor="ERROR"), report_of("roof_sensor", sensor="OK"),
            report_of("pump", levels="ERROR"),
        ),
        # The controller reports the loss of a forecast only if the weather node reports nothing.
        (
            report_of("weather", forecast="ERROR"), report_of("weather", forecast="OK"),
            report_of("mpc", "no_forecast", forecast="WARN"),
        ),
    ],
)
def test_what_follows_from_a_loss_is_none_of_its_own(
    monkeypatch: pytest.MonkeyPatch, loss: dict[str, Any], end: dict[str, Any],
    consequence: dict[str, Any],
) -> None:
    """It does not count while something is lost; alone, it does after half a minute."""
    clock = iter(range(1000))
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    log = IncidentLog(lambda _: None)
    for _ in range(40):
        log.update({**consequence, **loss})
    assert [incident.node for incident in log.incidents] == list(loss)
    reads = 0
    while log.count == 1:
        log.update({**end, **consequence})
        reads += 1
    assert reads > 25
    assert [incident.node for incident in log.incidents] == [*loss, *consequence]


def test_what_has_not_come_yet_is_not_lost() -> None:
    log = IncidentLog(lambda _: None)
    for level in ("WARN", "ERROR"):
        log.update(report_of("pump", drive=level), starting=True)
    assert log.count == 0
    log.update(report_of("pump", drive="OK"), starting=True)
    log.update(report_of("pump", drive="ERROR"), starting=True)
    assert log.count == 1


def test_a_disk_that_is_full_stops_no_one(tmp_path: Path) -> None:
    """With a directory in place of the file, it cannot be written, and this is reported."""
    messages: list[str] = []
    (tmp_path / INCIDENTS).mkdir()
    log = IncidentLog(messages.append, tmp_path / INCIDENTS)
    log.update(report_of("pump", drive="ERROR"), 5)
    assert log.count == 1
    assert DISK.wait(60)
    assert any("Is a directory" in line for line in messages)


def test_a_file_that_is_read_back(tmp_path: Path) -> None:
    """A crash can cut the last line short; any other invalid line is reported."""
    line = json.dumps(asdict(Incident(1, "pump", "drive", "gone", "2026-11-23T20:55:01+00:00")))
    path = tmp_path / INCIDENTS
    path.write_text(f"{line}\n{line[:40]}")
    assert [incident.number for incident in read_incidents(tmp_path)] == [1]
    for broken in ("nonsense", '{"number": 1}', "[]"):
        path.write_text(f"{line}\n{broken}\n{line}\n")
        with pytest.raises(ValueError, match=r"incidents.jsonl, line 2: is not an incident"):
            read_incidents(tmp_path)


def test_what_never_came_is_missing_since_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not since a minute later, when it is no longer waited for."""
    now = datetime(2026, 11, 23, 20, 0, tzinfo=timezone.utc)
    monkeypatch.setattr(incidents, "wall_time", lambda: now.isoformat())
    messages: list[str] = []
    log = IncidentLog(messages.append)
    now += timedelta(seconds=60)
    log.update(report_of("pump", drive="ERROR"))
    now += timedelta(seconds=10)
    log.update(report_of("pump", drive="OK"))
    assert messages == [
        "incident 1: pump: since the start: drive ERROR",
        "incident 1 is over, after 70.0 s: pump: drive",
    ]


def test_another_start_keeps_what_was_before(tmp_path: Path) -> None:
    """Numbers continue; older incidents have ended by then at the latest; a cut line is dropped."""
    first = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    for level in ("OK", "ERROR", "OK", "ERROR"):
        first.update(report_of("pump", drive=level))
    assert DISK.wait(60)
    with (tmp_path / INCIDENTS).open("a") as stream:
        stream.write('{"number": 3, "no')
    second = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    second.resume()
    second.update(report_of("pump", drive="OK"))
    second.update(report_of("pump", drive="ERROR"))
    assert DISK.wait(60)
    incidents = read_incidents(tmp_path)
    assert [incident.number for incident in incidents] == [1, 2, 3]
    assert [incident.ended is None for incident in incidents] == [False, False, True]
    assert second.count == 1


def test_the_numbers_of_a_start_go_on_from_the_file(tmp_path: Path) -> None:
    """``incident 6`` is not followed by ``5 incidents`` without a word."""
    printed: list[str] = []
    first = IncidentLog(printed.append, tmp_path / INCIDENTS)
    first.fail("pump", "ended")
    assert first.numbers == ""
    DISK.wait(5)
    again = IncidentLog(printed.append, tmp_path / INCIDENTS)
    again.resume()
    for _ in range(2):
        again.fail("pump", "ended")
    assert printed[-1].startswith("incident 3")
    assert with_incidents("done", again.count) + again.numbers == (
        "done, with 2 incidents since this start (number 2 to 3)"
    )


def test_a_flapping_sensor_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files keep the newest; numbers go on, and what lasts is kept whenever it began."""
    monkeypatch.setattr(incidents, "_FULL", 20_000)
    log = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    log.update(report_of("roof_sensor", drive="ERROR"))  # it lasts for all this time
    for number in range(500):
        for level in ("ERROR", "OK"):
            log.update(report_of("pump", drive=level))
        if number % 50 == 0:
            assert DISK.wait(60)
    assert DISK.wait(60)
    assert (log.count, log.changes) == (501, 1001)
    assert sorted(file.name for file in tmp_path.iterdir()) == [INCIDENTS, f"{INCIDENTS}.1"]
    assert all(file.stat().st_size < 21_000 for file in tmp_path.iterdir())
    lasting, *newest = read_incidents(tmp_path)
    assert (lasting.number, lasting.ended) == (1, None)
    assert [known.number for known in newest] == list(range(502 - len(newest), 502))
    assert len(newest) > 50 and all(known.ended for known in newest)
    second = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    second.resume()
    second.update(report_of("pump", drive="ERROR"))
    assert DISK.wait(60)
    lasting, *_, last = read_incidents(tmp_path)
    assert (lasting.number, lasting.ended is None, last.number) == (1, False, 502)


@pytest.mark.parametrize("cut", ["", '{"number": 3, "no'])
def test_a_killed_change_of_files_loses_no_number(tmp_path: Path, cut: str) -> None:
    """Between the renaming and the first line, or in that line."""
    first = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    for level in ("ERROR", "OK", "ERROR"):
        first.update(report_of("pump", drive=level))
    assert DISK.wait(60)
    (tmp_path / INCIDENTS).rename(tmp_path / f"{INCIDENTS}.1")
    if cut:
        (tmp_path / INCIDENTS).write_text(cut)
    second = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    second.resume()
    second.update(report_of("pump", drive="ERROR"))
    assert DISK.wait(60)
    assert [(known.number, bool(known.ended)) for known in read_incidents(tmp_path)] == [
        (1, True), (2, True), (3, False)
    ]


def test_a_file_of_any_size_is_read_in_bounded_memory(tmp_path: Path) -> None:
    """As an earlier version may have left it: the newest incidents count, at a start, too."""
    moment = "2026-11-23T20:55:01+00:00"
    line = asdict(Incident(1, "pump", "drive", "gone", moment, moment))
    with (tmp_path / INCIDENTS).open("w") as stream:
        stream.writelines(f"{json.dumps(line | {'number': n})}\n" for n in range(1, 400_001))
    assert (tmp_path / INCIDENTS).stat().st_size > 60_000_000
    tracemalloc.start()
    log = IncidentLog(lambda _: None, tmp_path / INCIDENTS)
    known = read_incidents(tmp_path)
    assert known[-1].number == 400_000
    log.resume()
    assert DISK.wait(600)
    assert tracemalloc.get_traced_memory()[1] < 60_000_000
    tracemalloc.stop()
