"""What is an alarm, by the table of conditions: beginning, end, cause, advice, and its status."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from greenroof_ros.interface.alarm import ERROR, LEVELS, OTHER, STALE, WARN, Alarm, advise
from greenroof_ros.interface.conditions import (
    LATCHED,
    Diagnosis,
    read_conditions,
    read_interlocks,
)
from greenroof_ros.ros.alarm_status import read_status, to_status
from greenroof_ros.ros.alarms import Judge, find_causes
from greenroof_ros.ros.reports import StatusDiagnosis

NOON = 1_800_000_000.0


def wrong(code: str, role: str = "pump", level: int = ERROR, **more: Any) -> StatusDiagnosis:
    """Return a diagnosis with this code, which began at 100 s unless it is given."""
    what = {"since": 0.0, "began": 100.0, "sentence": f"it is {code}", **more}
    return StatusDiagnosis(0, "", "", role, code, LEVELS[level], **what)


def named(diagnoses: dict[str, StatusDiagnosis]) -> dict[str, StatusDiagnosis]:
    """Return diagnoses of the nodes and parts in their names."""
    return {
        name: replace(diagnosis, node=name.partition(": ")[0], part=name.partition(": ")[2])
        for name, diagnosis in diagnoses.items()
    }


class Site:
    """A judge, and the alarms that have begun, changed and ended."""

    def __init__(self) -> None:
        self.judge, self.wall = Judge(), 100.0
        self.changed: list[Alarm] = []

    def passes(
        self, seconds: float, diagnoses: dict[str, StatusDiagnosis], starting: bool = False
    ) -> None:
        """Judge these diagnoses for some seconds, four times in each."""
        for _ in range(max(1, round(4 * seconds))):
            self.wall += 0.25
            self.changed += self.judge.update(
                self.wall, NOON + self.wall, named(diagnoses), starting=starting
            )

    @property
    def told(self) -> list[tuple[str, str, bool]]:
        """The name and code of the alarms that changed, and whether they had ended."""
        return [(alarm.name, alarm.code, alarm.ended is not None) for alarm in self.changed]


def test_an_alarm_begins_and_ends() -> None:
    """Since what its node reports; its duration is by the steady clock, whatever the system's is.

    Other words under the same code are the same alarm; another fault is another one.
    """
    site = Site()
    fault = wrong("drive_fault", since=NOON - 3600, began=-3500.0, fault="2310")
    site.passes(1, {"/pump: drive": fault})
    site.passes(9, {"/pump: drive": replace(fault, sentence="for 9 s")})
    (alarm,) = site.judge.present.values()
    assert (alarm.number, alarm.node, alarm.part, alarm.level, alarm.sentence) == (
        1, "/pump", "drive", "error", "for 9 s"
    )
    assert (alarm.since, alarm.ended, alarm.seconds) == (NOON - 3600, None, None)
    site.judge.update(111.0, NOON - 7200, {})  # the system's clock was set back
    (alarm,) = site.judge.over
    assert (alarm.ended, alarm.seconds) == (alarm.since, 3611.0)
    for drive in (fault, replace(fault, fault="2320"), replace(fault, code="drive_lost")):
        site.passes(1, {"/pump: drive": drive})
    assert [alarm.number for alarm in site.judge.over] == [3, 2, 1]
    assert [code for _, code, _ in site.told] == 5 * ["drive_fault"] + ["drive_lost"]


@pytest.mark.parametrize(("code", "seconds"), [
    ("drive_lost", 0), ("a code of another version", 0), ("sensor_lost", 3),
    ("input_publishers", 5),
])
def test_how_long_it_lasts_before_it_is_an_alarm(code: str, seconds: float) -> None:
    """One bad answer of a sensor is none; nor is a restarted one a second publisher."""
    site = Site()
    if seconds:
        site.passes(seconds - 0.25, {"/pump: part": wrong(code)})
        assert not site.changed
    site.passes(0.5, {"/pump: part": wrong(code)})
    assert site.told == [("/pump: part", code, False)]


def test_what_may_still_come_while_a_site_starts_is_only_missing() -> None:
    """It has a minute; what was there is lost, and what no time mends is an alarm at once."""
    site = Site()
    drive, pump = "/pump: drive", "/pump: pump"
    late, fault = wrong("drive_lost"), wrong("drive_fault")
    site.passes(59, {drive: late, pump: fault}, starting=True)
    assert site.told == [(pump, "drive_fault", False)]
    (missing,) = site.judge.missing.values()
    assert (missing.name, missing.number, missing.level) == (drive, 0, "warn")
    site.passes(1, {drive: late, pump: fault})
    assert site.told[1:] == [(drive, "drive_lost", False)]
    lost = Site()
    lost.passes(1, {drive: replace(late, was_good=True)}, starting=True)
    assert lost.told == site.told[1:]


def test_what_follows_from_another_one() -> None:
    """It waits with its cause until that is an alarm; if the cause ends first, that is a change."""
    site = Site()
    sensor = {"/roof_sensor: sensor": wrong("sensor_lost", "roof_sensor")}
    levels = {"/pump: levels": wrong("input_silent", about=("/roof/level",))}
    site.passes(2, sensor | levels)
    assert not site.changed
    site.passes(2, sensor | levels)
    site.passes(2, levels)
    assert [(alarm.name, alarm.follows, alarm.ended is None) for alarm in site.changed] == [
        ("/roof_sensor: sensor", "", True),
        ("/pump: levels", "/roof_sensor: sensor", True),
        ("/roof_sensor: sensor", "", False),
        ("/pump: levels", "", True),
    ]


@pytest.mark.parametrize(("diagnoses", "causes"), [
    # The sensor comes first; the rest follows from it.
    ({
        "/cistern_sensor: sensor": wrong("sensor_lost", "cistern_sensor"),
        "/onoff: inputs": wrong("input_silent", "controller", about=("/cistern/level",)),
        "/pump: levels": wrong("input_silent", about=("/cistern/level",)),
        "/pump: pump": wrong("cistern_level_unknown", level=WARN),
    }, "/cistern_sensor: sensor"),
    # Of two sensors, the one that publishes the topic.
    ({
        "/roof_sensor: sensor": wrong("sensor_lost", "roof_sensor"),
        "/cistern_sensor": wrong("not_heard", "cistern_sensor", STALE),
        "/pump: levels": wrong("input_silent", about=("/cistern/level",)),
    }, {"/pump: levels": "/cistern_sensor"}),
    # Without a forecast there is no temperature.
    ({
        "/weather: forecast": wrong("forecast_missing", "weather"),
        "/weather: frost": wrong("temperature_unknown", "weather"),
        "/pump: frost": wrong("temperature_unknown", level=WARN, about=("/weather/frost",)),
    }, "/weather: forecast"),
    # Frost is told by the weather node, with its temperature.
    ({
        "/pump: pump": wrong("frost", level=WARN), "/pump: frost": wrong("frost", level=WARN),
        "/weather: frost": wrong("freezing", "weather", WARN),
    }, "/weather: frost"),
    # A second controller explains that there is no command.
    ({
        "/pump: command": wrong("input_publishers"),
        "/pump: pump": wrong("command_unknown", level=WARN),
    }, "/pump: command"),
    # A level that only its readers find wrong: the pump node knows the most about it.
    ({
        "/pump: levels": wrong("input_frozen", about=("/roof/level",)),
        "/mpc: inputs": wrong("input_frozen", "controller", about=("/roof/level",)),
    }, "/pump: levels"),
    # A node that waits follows from the one it waits for; no error follows from a warning.
    ({
        "/weather": wrong("not_heard", "weather", STALE),
        "/mpc": wrong("peers_awaited", "controller", WARN, about=("weather",)),
        "/mpc: inputs": wrong("input_waiting", "controller", WARN, about=("/roof/level",)),
        "/pump: command": wrong("input_silent", level=STALE, about=("/pump/command",)),
    }, "/weather"),
    ({
        "/mpc": wrong("peers_awaited", "controller", WARN, about=("plant",)),
        "/mpc: inputs": wrong("input_refused", "controller", about=("/roof/level",)),
    }, {}),
    # The pump's state follows from the part that reports more, and from no other part.
    ({
        "/pump: pump": wrong("roof_level_unknown", level=WARN),
        "/pump: levels": wrong("input_frozen"),
    }, "/pump: levels"),
    # A pump that needs a person at it follows from nothing.
    ({"/pump: drive": wrong("drive_lost"), "/pump: pump": wrong("hold", level=WARN)}, {}),
])
def test_causes(
    diagnoses: dict[str, StatusDiagnosis], causes: str | dict[str, str]
) -> None:
    if isinstance(causes, str):
        causes = dict.fromkeys(diagnoses.keys() - {causes}, causes)
    diagnoses = named(diagnoses)
    assert find_causes(diagnoses) == causes
    assert find_causes(dict(reversed(diagnoses.items()))).keys() == causes.keys()


# --- devices on one line, and an operator's words -------------------------------------------------


def test_devices_that_fall_silent_together_are_one_alarm() -> None:
    """Behind one broker or line, within seconds; the missing levels follow from it, too."""
    site = Site()
    broker = {"line": "192.168.0.2:1883"}
    parts = {
        "/a/roof_sensor: sensor": wrong("broker_lost", "roof_sensor", **broker),
        "/a/cistern_sensor: sensor": wrong("sensor_lost", "cistern_sensor", began=101.0, **broker),
        "/a/pump: drive": wrong("drive_lost", **broker),
    }
    follows = {
        "/a/pump: levels": wrong("input_silent", about=("/roof/level",)),
        "/a/rain_gauge: gauge": wrong("sensor_lost", "rain_gauge", WARN, line="/dev/ttyUSB0"),
    }
    site.passes(5, parts | follows)
    group = "/a/alarms: 192.168.0.2:1883"
    assert {name: alarm.follows for name, alarm in site.judge.present.items()} == {
        group: "", "/a/rain_gauge: gauge": "", "/a/pump: levels": group,
        **dict.fromkeys(parts, group),
    }
    assert site.judge.present[group].sentence == (
        "cistern sensor, pump and roof sensor fell silent at the same time"
    )
    site.passes(1, follows)
    assert site.judge.present.keys() == {*follows}
    later = wrong("sensor_lost", "roof_sensor", began=150.0, **broker)
    site.passes(60, {**parts, "/a/roof_sensor: sensor": later, "/a/pump: drive": wrong("hold")})
    assert [alarm.follows for alarm in site.judge.present.values()] == ["", "", ""]


def test_an_alarm_names_no_topic_or_address() -> None:
    """But the labels of its topics, and a temperature."""
    site = Site()
    levels = wrong("input_refused", about=("/cistern/level", "/roof/level"))
    site.passes(6, {"/pump: levels": levels})
    assert site.changed[0].sentence == "no valid cistern level or roof level arrives"
    for code, condition in read_conditions().items():
        assert not re.search(r"{(topic|problem|why)}|/|%", condition.headline), code
    assert Diagnosis.of("freezing", "measured", temperature=-1.25).sentence == (
        "it is freezing, at -1.2 °C as measured; pumping goes on above 0 °C"
    )


@pytest.mark.parametrize("role", ["pump", "weather", "controller", "roof_sensor"])
def test_every_code_has_advice_for_whoever_stands_at_the_pump(role: str) -> None:
    """It has no commands of ROS, and no names of codes and parameters."""
    for code in read_conditions():
        advice = advise(code, role, "/site1/node")
        assert advice != OTHER and "{" not in advice
        assert not re.search(r"\bros2\b|\b[a-z]+_[a-z]+|\bm3\b", advice), (code, advice)
    for code, interlock in read_interlocks().items():
        if interlock.kind == LATCHED:
            assert "clear" in advise(code, "pump", "/site1/pump")
    assert "greenroof release --namespace site1" in advise("hold", "pump", "/site1/pump")
    assert advise("of another version", "pump", "/pump") == OTHER


# --- the status on /alarms ------------------------------------------------------------------------

SILENT = Alarm(
    7, "/site1/pump", "inputs", "pump", "input_silent", "error", "the roof sensor is silent",
    since=1_700_000_000.0, follows="/site1/roof_sensor: sensor", about=("/roof/level", "/x"),
    fault="F 7",
)


def test_status_of_an_alarm() -> None:
    """A status has the level as now, and plain values; what does not apply is left out."""
    level, values = to_status(SILENT)
    assert (level, values) == (2, {
        "number": "7", "role": "pump", "code": "input_silent", "fault": "F 7",
        "since": "2023-11-14T22:13:20.000+00:00", "follows": "/site1/roof_sensor: sensor",
        "about": "/roof/level /x", "serious": "true",
    })
    missing = replace(SILENT, number=0, level="warn")
    assert "number" not in to_status(missing)[1]
    ended = {"ended": 1_700_000_060.0, "seconds": 60.5}
    over, minor = replace(SILENT, **ended), replace(SILENT, level="warn", **ended)
    for alarm, shown in ((SILENT, 2), (missing, 1), (over, 0), (minor, 0)):
        level, values = to_status(alarm)
        assert level == shown
        assert read_status(alarm.name, level, alarm.sentence, values) == alarm
    for broken in ({"number": "x"}, {"since": "now"}, {"seconds": "long"}):  # of any program
        with pytest.raises(ValueError, match=r"x|now|long"):
            read_status("/pump", 2, "", broken)
