"""What is printed and stored of alarms, and how it is read back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from greenroof_ros.interface.alarm import ALARMS, Alarm, to_record
from greenroof_ros.nodes import alarm_log
from greenroof_ros.nodes.alarm_log import AlarmLog
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.ros.alarms import Change

BEGAN = 1_795_000_000.25
LOST = Alarm(
    1, "/pump", "drive", "pump", "drive_lost", "error", "no connection", BEGAN,
    about=("/pump/flow",),
)


def begins(number: int = 1, **more: object) -> Change:
    return Change("begins", replace(LOST, number=number, **more))  # type: ignore[arg-type]


def ends(number: int = 1) -> Change:
    return Change("ends", replace(LOST, number=number, ended=BEGAN + 9, seconds=7.8))


def written(directory: Path, *changes: Change, read: Callable[[str], None] = print) -> AlarmLog:
    """Return a log that has stored these changes."""
    log = AlarmLog(read, directory / ALARMS)
    log.add(changes)
    log.wait(60)
    return log


def test_each_change_is_printed_and_stored_at_once(tmp_path: Path) -> None:
    """The last line with a number counts; a level or cause that changes is stored only."""
    printed: list[str] = []
    follows = {"follows": "/pump: drive", "part": "pump", "level": "warn"}
    written(
        tmp_path, begins(), begins(2, **follows), Change("changes", replace(LOST, level="stale")),
        ends(), Change("returns", LOST), ends(), read=printed.append,
    )
    assert printed == [
        "alarm 1: Pump: no connection",
        "warning 2: Pump: no connection (follows from Pump)",
        "alarm 1 is over, after 7.8 s: Pump",
        "alarm 1 has returned: Pump: no connection",
        "alarm 1 is over, after 7.8 s: Pump",
    ]
    assert read_alarms(tmp_path) == [ends().alarm, begins(2, **follows).alarm]
    first = json.loads((tmp_path / ALARMS).read_text().splitlines()[0])
    assert first["since"] == "2026-11-18T11:06:40.250+00:00" and first["ended"] is None


def test_another_start_keeps_what_was_before(tmp_path: Path) -> None:
    """Numbers continue; older alarms have ended by then at the latest; a cut line is dropped."""
    written(tmp_path, begins(), ends(), begins(2))
    with (tmp_path / ALARMS).open("a") as stream:
        stream.write('{"number": 3, "no')
    log = written(tmp_path)
    assert log.last_number == 2
    first, second = read_alarms(tmp_path)
    assert (first.seconds, second.seconds) == (7.8, None)
    assert second.ended is not None and second.ended > BEGAN


@pytest.mark.parametrize("cut", ["", '{"number": 3, "no'])
def test_a_killed_change_of_files_loses_no_number(tmp_path: Path, cut: str) -> None:
    """Between the renaming and the first line, or in that line."""
    written(tmp_path, begins(), ends(), begins(2))
    (tmp_path / ALARMS).rename(tmp_path / f"{ALARMS}.1")
    if cut:
        (tmp_path / ALARMS).write_text(cut)
    assert written(tmp_path).last_number == 2
    assert [(alarm.number, bool(alarm.ended)) for alarm in read_alarms(tmp_path)] == [
        (1, True), (2, True),
    ]


def test_a_flapping_sensor_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two files keep the newest; what lasts is kept whenever it began."""
    monkeypatch.setattr(alarm_log, "_FULL", 20_000)
    log = written(tmp_path, begins(part="state file"))
    for number in range(2, 502):
        log.add([begins(number), ends(number)])
        if number % 50 == 0:
            log.wait(60)
    log.wait(60)
    assert sorted(file.name for file in tmp_path.iterdir()) == [ALARMS, f"{ALARMS}.1"]
    assert all(file.stat().st_size < 21_000 for file in tmp_path.iterdir())
    lasting, *newest = read_alarms(tmp_path)
    assert (lasting.number, lasting.ended) == (1, None)
    assert [alarm.number for alarm in newest] == list(range(502 - len(newest), 502))
    assert len(newest) > 50 and all(alarm.ended for alarm in newest)


def test_a_disk_that_is_full_and_a_damaged_file_stop_no_one(tmp_path: Path) -> None:
    printed: list[str] = []
    (tmp_path / "full" / ALARMS).mkdir(parents=True)
    log = written(tmp_path / "full", begins(), read=printed.append)
    assert any("Is a directory" in line for line in printed)
    (tmp_path / "full" / ALARMS).rmdir()  # now there is room
    log.write()
    log.wait(60)
    assert read_alarms(tmp_path / "full") == [LOST]
    line = json.dumps(to_record(LOST))
    for broken in ("nonsense", '{"number": 1}', "[]", "[" * 100_000):
        (tmp_path / ALARMS).write_text(f"{line}\n{broken}\n{line}\n")
        with pytest.raises(ValueError, match=r"alarms.jsonl, line 2: is not an alarm"):
            read_alarms(tmp_path)
        written(tmp_path, read=printed.append)
        assert "alarms from before this start will not be shown" in printed[-1]
