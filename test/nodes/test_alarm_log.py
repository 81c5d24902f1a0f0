"""What is printed and stored of alarms, and how it is read back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from greenroof_ros.interface.alarm import ALARMS, Alarm, read_alarms, to_record
from greenroof_ros.nodes import alarms
from greenroof_ros.nodes.alarms import AlarmLog

LOST = Alarm(
    1, "/pump", "drive", "pump", "drive_lost", "error", "no connection", 1_795_000_000.25,
    about=("/pump/flow",),
)


def begins(number: int = 1, **more: Any) -> Alarm:
    return replace(LOST, number=number, **more)


def ends(number: int = 1) -> Alarm:
    return begins(number, ended=LOST.since + 9, seconds=7.8)


def written(directory: Path, *alarms: Alarm, read: Callable[[str], None] = print) -> AlarmLog:
    """Return a log that has stored these alarms."""
    log = AlarmLog(read, directory / ALARMS)
    log.add(alarms)
    log.wait(60)
    return log


def test_each_change_is_printed_and_stored_at_once(tmp_path: Path) -> None:
    """The last line with a number counts; a level or cause that changes is stored only.

    After another start, numbers continue; older alarms have ended by then at the latest; a cut line
    is dropped.
    """
    printed: list[str] = []
    second = begins(2, follows="/pump: drive", part="pump", level="warn")
    written(tmp_path, begins(), second, begins(level="stale"), ends(), read=printed.append)
    assert [line[:10] for line in printed] == ["alarm 1: P", "warning 2:", "alarm 1 is"]
    assert read_alarms(tmp_path) == [ends(), second]
    first = json.loads((tmp_path / ALARMS).read_text().splitlines()[0])
    assert first["since"] == "2026-11-18T11:06:40.250+00:00" and first["ended"] is None
    with (tmp_path / ALARMS).open("a") as stream:
        stream.write('{"number": 3, "no')
    assert written(tmp_path, begins(3)).last_number == 2
    first, ended, third = read_alarms(tmp_path)
    assert (first, third) == (ends(), begins(3))
    assert ended.ended is not None and ended.ended > LOST.since


def test_a_flapping_sensor_fills_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file keeps the newest; what lasts is kept whenever it began."""
    monkeypatch.setattr(alarms, "_FULL", 20_000)
    monkeypatch.setattr(alarms, "_KEPT", 50)
    log = written(tmp_path, begins(part="state file"))
    for number in range(2, 252):
        log.add([begins(number), ends(number)])
        log.write()
        if number % 25 == 1:
            log.wait(60)
    log.write()  # as in every second, since the file may have become full meanwhile
    log.wait(60)
    assert [file.name for file in tmp_path.iterdir()] == [ALARMS]
    assert (tmp_path / ALARMS).stat().st_size < 40_000
    lasting, *newest = read_alarms(tmp_path)
    assert (lasting.number, lasting.ended, newest[-1]) == (1, None, ends(251))
    assert len(newest) >= 49


def test_a_disk_that_is_full_and_a_damaged_file_stop_no_one(tmp_path: Path) -> None:
    printed: list[str] = []
    (tmp_path / ALARMS).mkdir()
    log = written(tmp_path, begins(), begins(2), read=printed.append)
    assert sum("Is a directory" in line for line in printed) == 1
    (tmp_path / ALARMS).rmdir()  # now there is room
    log.write()
    log.add([ends(2)])
    log.wait(60)
    assert read_alarms(tmp_path) == [LOST, ends(2)]
    line = json.dumps(to_record(LOST))
    for broken in ("nonsense", '{"number": 1}', "[]", "[" * 100_000):
        (tmp_path / ALARMS).write_text(f"{line}\n{broken}\n{line}\n")
        with pytest.raises(ValueError, match=r"alarms.jsonl, line 2: is not an alarm"):
            read_alarms(tmp_path)
        written(tmp_path, read=printed.append)
        assert "alarms from before this start will not be shown" in printed[-1]
