"""The supervisor and the page judge the same reports alike."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from greenroof_ros import __version__
from greenroof_ros.base.disk import DISK
from greenroof_ros.base.times import iso
from greenroof_ros.interface.alarm import ALARMS
from greenroof_ros.live.site_alarms import SiteAlarms
from greenroof_ros.live.supervisor import NodeSetup, ProcessStart
from greenroof_ros.live.supervisor_socket import read_report
from greenroof_ros.results.alarm_file import read_alarms
from greenroof_ros.watch.store import GraphStore
from greenroof_ros.watch.wire import WireStatus

NOON = 1_800_000_000.0
OK, WARN, ERROR, STALE = range(4)
# What each part of a node reports from a time on (s): level and code. One bad answer of the roof's
# sensor is no alarm, nor is a forecast that comes while the site starts.
SCRIPT: dict[str, dict[str, list[tuple[float, int, str]]]] = {
    "cistern_sensor": {"sensor": [(0, OK, ""), (10, ERROR, "sensor_lost"), (30, OK, "")]},
    "roof_sensor": {"sensor": [(0, OK, ""), (11, ERROR, "sensor_lost"), (13, OK, "")]},
    "weather": {"forecast": [(0, ERROR, "forecast_missing"), (25, OK, "")]},
    "pump": {
        "levels": [(0, OK, ""), (15, ERROR, "input_silent"), (31, ERROR, "input_recovering"),
                   (41, OK, "")],
        "pump": [(0, OK, ""), (15, WARN, "cistern_level_unknown"), (41, OK, ""),
                 (90, ERROR, "drive_fault")],
        "drive": [(0, WARN, "drive_awaited"), (6, OK, ""), (90, ERROR, "drive_fault")],
    },
}
TOPICS = {"levels": "/cistern/level"}
# When processes die, and report again (s): the second sooner than its silence would be noticed.
DEATHS = {"weather": (60.0, 70.0), "cistern_sensor": (100.25, 102.0)}


def reports_at(seconds: float) -> dict[str, tuple[dict[str, Any], dict[str, Any]]]:
    """Return the values of each node that reports, and the statuses of its parts."""
    reports = {}
    for node, parts in SCRIPT.items():
        dies, returns = DEATHS.get(node, (math.inf, math.inf))
        if dies <= seconds < returns:
            continue
        statuses = {}
        for part, steps in parts.items():
            began, level, code = next(step for step in reversed(steps) if step[0] <= seconds)
            values = {}
            if code:
                values = {
                    "code": code, "since": iso(NOON + began), "age_s": f"{seconds - began:.1f}",
                }
                values |= {"topic": TOPICS[part]} if part in TOPICS else {}
            statuses[part] = {"level": level, "message": code or "well", "values": values}
        reports[node] = {
            "role": node, "process": f"host {2 if seconds >= returns else 1}", "up_s": seconds + 31,
        }, statuses
    return reports


def test_console_record_summary_and_page_have_the_same_alarms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page receives once a second; one that begins late has what still lasts, since then."""
    now, printed = 0.0, list[str]()
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0 + now)
    monkeypatch.setattr(time, "time", lambda: NOON + now)
    site = SiteAlarms(
        tmp_path, "/site1", [
            ProcessStart(node, "module", (), {node: NodeSetup("module", {})}) for node in SCRIPT
        ], printed.append
    )
    pages = {begins: GraphStore("/site1") for begins in (0.0, 32.0, 62.0)}
    of_pages: dict[float, dict[tuple[str, str], float]] = {begins: {} for begins in pages}
    received: dict[str, Any] = {}
    for step in range(480):
        now = step / 4
        said = reports_at(now)
        for node, (values, statuses) in said.items():
            line = {
                "node": node, "state": "ready", "version": __version__, **values,
                "diagnoses": statuses, "published_at": 1000.0 + math.floor(now),
            }
            received[node] = read_report(json.dumps(line).encode())
        for node, (dies, _) in DEATHS.items():
            if now == dies:
                del received[node]
                site.fail(node, "ended (SIGKILL); starts again in 1 s")
        site.update(received)
        for begins, page in pages.items():
            if now < begins:
                continue
            page.update(now, NOON + now)
            if now % 1 == 0:
                page.add_statuses(now, [
                    status for node, (values, statuses) in said.items() for status in (
                        WireStatus(f"/site1/{node}", OK, "ready", {
                            key: json.dumps(value) for key, value in values.items()
                        }),
                        *(WireStatus(f"/site1/{node}: {part}", *status.values())
                          for part, status in statuses.items()),
                    )
                ])
            of_pages[begins] |= {
                (alarm.name, alarm.code): alarm.since for alarm in page.judge.present.values()
            }
    assert DISK.wait(60)
    expected = {
        ("/site1/cistern_sensor: sensor", "sensor_lost"): 10.0,
        ("/site1/pump: levels", "input_silent"): 15.0,
        ("/site1/pump: pump", "cistern_level_unknown"): 15.0,
        ("/site1/weather", "not_heard"): 59.0,
        ("/site1/pump: drive", "drive_fault"): 90.0,
        ("/site1/pump: pump", "drive_fault"): 90.0,
        ("/site1/cistern_sensor", "not_heard"): 100.0,
    }
    recorded = read_alarms(tmp_path)
    assert {(alarm.name, alarm.code): alarm.since - NOON for alarm in recorded} == expected
    records = site.log.as_records()
    assert [record["number"] for record in records] == list(range(1, len(expected) + 1))
    assert records == [
        json.loads(line) for line in {
            json.loads(line)["number"]: line
            for line in (tmp_path / ALARMS).read_text().splitlines()
        }.values()
    ]
    begun = [line for line in printed if line.startswith(("alarm", "warning"))
             and " is over" not in line]
    assert [line.split(": ")[1] for line in begun] == [alarm.node for alarm in recorded]
    late = [*expected][-3:]
    for begins, names in (
        (0.0, [*expected]),
        (32.0, [*late, ("/site1/pump: pump", "cistern_level_unknown"),
                ("/site1/weather", "not_heard")]),
        (62.0, late),
    ):
        assert of_pages[begins].keys() == {*names}
        for name in names:
            assert of_pages[begins][name] - NOON == expected[name], (begins, name)


# A system clock that a process may set for itself alone, by `jump` (s).
CLOCK_C = """
#define _GNU_SOURCE
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
long jump = 0;
int clock_gettime(clockid_t clock, struct timespec *now) {
    int result = syscall(SYS_clock_gettime, clock, now);
    if (clock == CLOCK_REALTIME) now->tv_sec += jump;
    return result;
}
"""
JUMPS = """
import ctypes, sys, time
from pathlib import Path
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.live_diagnostics import ERROR, LiveDiagnostics
from greenroof_ros.live.site_alarms import SiteAlarms
from unittest.mock import MagicMock
jump = ctypes.c_long.in_dll(ctypes.CDLL(None), "jump")
site, node = SiteAlarms(Path(sys.argv[1]), "", [], print), LiveDiagnostics(MagicMock(), "pump")
began = time.time()
for seconds, diagnosis in (
    (0, Diagnosis("drive_not_ready")), (int(sys.argv[2]), Diagnosis("drive_not_ready")), (0, None),
):
    jump.value += seconds
    node.diagnose("drive", diagnosis, "well", ERROR)
    status = node.diagnoses["drive"]
    site.update({"pump": {
        "role": "pump", "process": "host 1", "state": "ready", "up_s": 99.0, "diagnoses": {
            "drive": {"level": status.level[0], "message": status.message,
                      "values": status.for_programs()},
        },
    }})
    time.sleep(0.3)
assert abs(time.time() - began - int(sys.argv[2])) < 60
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
@pytest.mark.parametrize("jump", [-409_967_995, -3600, 86_400])
def test_how_long_an_alarm_lasts_when_the_system_clock_is_set(tmp_path: Path, jump: int) -> None:
    """While an alarm lasts: stamps are of that clock, spans are not."""
    source, library = tmp_path / "clock.c", tmp_path / "clock.so"
    source.write_text(CLOCK_C)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    ended = subprocess.run(
        [sys.executable, "-c", JUMPS, tmp_path, str(jump)], capture_output=True, text=True,
        env={**os.environ, "LD_PRELOAD": str(library)}, check=False,
    )
    assert ended.returncode == 0, ended.stderr
    (over,) = re.findall(r"is over, after (\S+) s: /pump: drive", ended.stdout)
    assert 0.5 < float(over) < 60
