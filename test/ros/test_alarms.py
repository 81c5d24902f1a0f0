"""What is an alarm, by the table of conditions: beginning, end, cause, and advice."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from greenroof_ros.interface.alarm import ERROR, FOREIGN, OTHER, STALE, WARN, Alarm, advise
from greenroof_ros.interface.conditions import (
    LATCHED,
    Diagnosis,
    read_conditions,
    read_interlocks,
)
from greenroof_ros.ros.alarms import Judge, find_causes
from greenroof_ros.ros.reports import StatusDiagnosis

NOON = 1_800_000_000.0


def wrong(code: str, role: str = "pump", level: int = ERROR, **more: Any) -> StatusDiagnosis:
    """Return a diagnosis with this code."""
    return StatusDiagnosis(level, f"it is {code}", code, role, **more)


class Site:
    """A judge, and what it has returned."""

    def __init__(self) -> None:
        self.judge, self.wall = Judge(), 100.0
        self.changes: list[tuple[str, Alarm]] = []

    def pass_time(self, seconds: float, starting: bool = False, **parts: StatusDiagnosis) -> None:
        """Judge these diagnoses of parts of the pump for some seconds, four times in each."""
        self.passes(seconds, {f"/pump: {part}": it for part, it in parts.items()}, starting)

    def passes(
        self, seconds: float, diagnoses: dict[str, StatusDiagnosis], starting: bool = False
    ) -> None:
        for _ in range(max(1, round(4 * seconds))):
            self.wall += 0.25
            now = NOON + self.wall
            self.changes += self.judge.update(self.wall, now, diagnoses, starting=starting)

    @property
    def told(self) -> list[tuple[str, str, str]]:
        """What changed, of which alarm, and its code."""
        return [(what, alarm.name, alarm.code) for what, alarm in self.changes]


def test_an_alarm_begins_and_ends() -> None:
    """Since what its node reports; its duration is by the steady clock, whatever the system's is.

    Other words under the same code are the same alarm.
    """
    site = Site()
    lost = wrong("drive_fault", since=NOON - 3600, age_s=3600.0)
    site.pass_time(1, drive=lost)
    site.pass_time(9, drive=replace(lost, sentence="for 9 s"))
    (alarm,) = site.judge.present.values()
    assert (alarm.node, alarm.part, alarm.level, alarm.sentence) == (
        "/pump", "drive", "error", "for 9 s"
    )
    assert (alarm.since, alarm.ended, alarm.seconds) == (NOON - 3600, None, None)
    site.judge.update(111.0, NOON - 7200, {})  # the system's clock was set back
    (alarm,) = site.judge.over
    assert (alarm.ended, alarm.seconds) == (NOON - 7200, 3610.8)
    assert site.told == [("begins", "/pump: drive", "drive_fault")]


@pytest.mark.parametrize(("code", "level", "seconds"), [
    ("drive_lost", ERROR, 0), ("drive_fault", ERROR, 0), ("not_recorded", ERROR, 0),
    ("hold", WARN, 0), ("drive_local", WARN, 0), ("a code of another version", ERROR, 0),
    ("sensor_lost", ERROR, 3), ("gauge_bad", WARN, 3), ("forecast_missing", ERROR, 3),
    ("input_recovering", ERROR, 30),
])
def test_how_long_it_lasts_before_it_is_an_alarm(code: str, level: int, seconds: float) -> None:
    """One bad answer of a sensor is none; a node's own age counts, so all decide alike."""
    site = Site()
    if seconds:
        site.pass_time(seconds, part=wrong(code, level=level))
        site.pass_time(1)
        assert not site.changes
    site.pass_time(seconds + 0.5, part=wrong(code, level=level))
    assert site.told == [("begins", "/pump: part", code)]
    other = Site()
    other.pass_time(0.25, part=wrong(code, level=level, age_s=seconds))
    assert other.told == site.told


def test_an_alarm_does_not_end_before_it_began() -> None:
    """The stamp of its node can be ahead of the time by which its end is dated."""
    site = Site()
    ahead = NOON + site.wall + 2.0
    site.pass_time(1, drive=wrong("drive_lost", since=ahead))
    site.pass_time(0.25)
    assert [(what, alarm.ended) for what, alarm in site.changes] == [
        ("begins", None), ("ends", ahead),
    ]


def test_another_code_or_fault_is_another_alarm() -> None:
    """Also if all was well in between; the same one within 10 s is the same alarm again."""
    site = Site()
    first = wrong("drive_fault", fault="2310")
    for drive in (
        first, wrong("drive_lost"), first, replace(first, fault="2320", sentence="another"),
    ):
        site.pass_time(1, drive=drive)
    assert site.told == [
        ("begins", "/pump: drive", "drive_fault"), ("ends", "/pump: drive", "drive_fault"),
        ("begins", "/pump: drive", "drive_lost"), ("ends", "/pump: drive", "drive_lost"),
        ("begins", "/pump: drive", "drive_fault"), ("ends", "/pump: drive", "drive_fault"),
        ("begins", "/pump: drive", "drive_fault"),
    ]
    site = Site()
    for seconds, parts in ((1, {"drive": first}), (9, {}), (1, {"drive": first}), (11, {}),
                           (1, {"drive": first})):
        site.pass_time(seconds, **parts)
    assert [(what, alarm.number) for what, alarm in site.changes] == [
        ("begins", 1), ("ends", 1), ("returns", 1), ("ends", 1), ("begins", 2),
    ]
    assert site.changes[2][1].since == site.changes[0][1].since


def test_what_may_still_come_while_a_site_starts_is_only_missing() -> None:
    """It has a minute; what was there is lost, and what no time mends is an alarm at once."""
    site = Site()
    late, fault = wrong("drive_lost"), wrong("drive_fault")
    site.pass_time(59, starting=True, drive=late, pump=fault)
    assert site.told == [("begins", "/pump: pump", "drive_fault")]
    assert site.judge.missing == {"/pump: drive": late}
    site.pass_time(1, drive=late, pump=fault)
    assert site.told[1:] == [("begins", "/pump: drive", "drive_lost")]
    lost = Site()
    lost.pass_time(1, starting=True, drive=replace(late, was_good=True))
    assert lost.told == site.told[1:]


def test_what_follows_from_another_one() -> None:
    """It waits with its cause until that is an alarm; if the cause ends first, that is a change."""
    site = Site()
    sensor = {"/roof_sensor: sensor": wrong("sensor_lost", "roof_sensor")}
    levels = {"/pump: levels": wrong("input_silent", about=("/roof/level",))}
    site.passes(2, sensor | levels)
    assert not site.changes
    site.passes(2, sensor | levels)
    assert [(what, alarm.name, alarm.follows) for what, alarm in site.changes] == [
        ("begins", "/roof_sensor: sensor", ""),
        ("begins", "/pump: levels", "/roof_sensor: sensor"),
    ]
    site.passes(2, levels)
    assert [(what, alarm.name, alarm.follows) for what, alarm in site.changes[2:]] == [
        ("ends", "/roof_sensor: sensor", ""), ("changes", "/pump: levels", ""),
    ]


TWO = wrong("input_publishers")


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
        "/weather: forecast": wrong("forecast_service_silent", "weather"),
        "/weather: frost": wrong("temperature_not_fetched", "weather"),
        "/mpc: forecast": wrong(
            "no_forecast", "controller", WARN, about=("/forecast/precipitation",)
        ),
        "/pump: frost": wrong("temperature_unknown", level=WARN, about=("/weather/frost",)),
    }, "/weather: forecast"),
    # A second controller explains bad inputs, and refused values.
    ({
        "/pump: command": TWO,
        "/pump: pump": wrong("command_unknown", level=WARN),
        "/pump: refused": wrong("values_refused", level=WARN, about=("/pump/command",)),
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
        "/pump: pump": wrong("drive_lost", level=WARN),
        "/pump: drive": wrong("drive_lost"),
    }, "/pump: drive"),
    ({
        "/pump: pump": wrong("roof_level_unknown", level=WARN),
        "/pump: levels": wrong("input_frozen"),
    }, "/pump: levels"),
    ({"/pump: pump": wrong("frost", level=WARN), "/pump: state file": wrong("frost")}, {}),
    # A pump that needs a person at it follows from nothing.
    ({"/pump: drive": wrong("drive_lost"), "/pump: pump": wrong("hold", level=WARN)}, {}),
])
def test_causes(
    diagnoses: dict[str, StatusDiagnosis], causes: str | dict[str, str]
) -> None:
    if isinstance(causes, str):
        causes = dict.fromkeys(diagnoses.keys() - {causes}, causes)
    assert find_causes(diagnoses) == causes
    assert find_causes(dict(reversed(diagnoses.items()))).keys() == causes.keys()


# --- devices on one line, and an operator's words -------------------------------------------------


def test_devices_that_fall_silent_together_are_one_alarm() -> None:
    """Behind one broker or line, within seconds; the missing levels follow from it, too."""
    site = Site()
    broker = {"line": "192.168.0.2:1883"}
    parts = {
        "/a/roof_sensor: sensor": wrong("broker_lost", "roof_sensor", **broker),
        "/a/cistern_sensor: sensor": wrong("sensor_lost", "cistern_sensor", **broker),
        "/a/pump: drive": wrong("drive_lost", **broker),
    }
    follows = {
        "/a/pump: levels": wrong("input_silent", about=("/roof/level",)),
        "/a/rain_gauge: gauge": wrong("sensor_lost", "rain_gauge", WARN, line="/dev/ttyUSB0"),
    }
    site.passes(5, parts | follows)
    alarms = {alarm.name: alarm for alarm in site.judge.present.values()}
    group = "/a/alarms: 192.168.0.2:1883"
    assert {name: alarm.follows for name, alarm in alarms.items()} == {
        group: "", "/a/rain_gauge: gauge": "", "/a/pump: levels": group,
        **dict.fromkeys(parts, group),
    }
    assert alarms[group].sentence == (
        "roof sensor, cistern sensor and pump fell silent at the same time"
    )
    assert "power" in advise("devices_lost", "alarms", "/a/alarms")
    site.passes(1, follows)
    assert site.judge.present.keys() == {*follows}


def test_devices_that_fall_silent_one_after_another_are_several() -> None:
    site = Site()
    line = {"line": "/dev/ttyUSB0"}
    roof = {"/roof_sensor: sensor": wrong("sensor_lost", "roof_sensor", **line)}
    site.passes(16, roof)
    cistern = {"/cistern_sensor: sensor": wrong("sensor_lost", "cistern_sensor", **line)}
    site.passes(4, roof | cistern)
    assert [alarm.follows for alarm in site.judge.present.values()] == ["", ""]


@pytest.mark.parametrize(("code", "about", "sentence"), [
    ("input_silent", ("/roof/level",), "no roof level arrives"),
    ("input_refused", ("/cistern/level", "/roof/level"),
     "no valid cistern level or roof level arrives"),
    ("two_pumps", ("/pump/flow",), "a second program reports the pump's flow"),
    ("forecast_missing", (), "it is forecast_missing"),
])
def test_an_alarm_names_no_topic(code: str, about: tuple[str, ...], sentence: str) -> None:
    site = Site()
    site.pass_time(6, part=wrong(code, about=about))
    assert [alarm.sentence for alarm in site.judge.present.values()] == [sentence]


def test_no_headline_has_a_topic_or_an_address() -> None:
    for code, condition in read_conditions().items():
        assert not re.search(r"{(topic|problem|why)}|/|%", condition.headline), code


def test_a_restarted_sensor_is_no_second_publisher() -> None:
    """It is known for 3 s after its death; a program that stays is an alarm."""
    site = Site()
    site.pass_time(4, levels=wrong("input_publishers"))
    site.pass_time(1)
    assert not site.changes
    site.pass_time(5.25, levels=wrong("input_publishers"))
    assert site.told == [("begins", "/pump: levels", "input_publishers")]


def test_frost_is_told_with_its_temperature() -> None:
    """As the weather node knows it; the pump's state follows from it."""
    causes = find_causes({
        "/pump: pump": wrong("frost", level=WARN), "/pump: frost": wrong("frost", level=WARN),
        "/weather: frost": wrong("freezing", "weather", WARN),
    })
    assert causes == dict.fromkeys(["/pump: pump", "/pump: frost"], "/weather: frost")
    diagnosis = Diagnosis.of("freezing", "measured", temperature=-1.25)
    assert diagnosis.sentence == (
        "it is freezing, at -1.2 °C as measured; pumping goes on above 0 °C"
    )


# --- advice ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", ["pump", "weather", "controller", "plant", "roof_sensor"])
def test_every_code_has_advice_for_whoever_stands_at_the_pump(role: str) -> None:
    """It has no commands of ROS, and no names of codes and parameters."""
    for code in read_conditions():
        advice = advise(code, role, "/site1/node")
        assert advice not in (OTHER, FOREIGN) and "{" not in advice
        assert not re.search(r"\bros2\b|\b[a-z]+_[a-z]+|\bm3\b", advice), (code, advice)
    for code, interlock in read_interlocks().items():
        if interlock.kind == LATCHED:
            assert "clear" in advise(code, "pump", "/site1/pump")
    assert "greenroof release --namespace site1" in advise("hold", "pump", "/site1/pump")
    assert advise("hold", "", "/camera") == FOREIGN
    assert advise("of another version", "pump", "/pump") == OTHER
