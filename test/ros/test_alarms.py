"""What is an alarm, by the table of conditions: beginning, end, cause, advice, and its status."""

from __future__ import annotations

import re
from typing import Any

import pytest

from greenroof_ros.interface.alarm import (
    ERROR,
    LEVELS,
    OTHER,
    STALE,
    WARN,
    Alarm,
    advise,
    read_status,
)
from greenroof_ros.interface.conditions import read_conditions
from greenroof_ros.ros.alarms import Judge, find_causes
from greenroof_ros.ros.reports import StatusDiagnosis

NOON = 1_800_000_000.0
Wrong = dict[str, StatusDiagnosis]


def wrong(name: str, code: str, *about: str, level: int = ERROR, **more: Any) -> Wrong:
    """Return what is wrong with a node or a part, which began at 100 s unless it is given."""
    node, _, part = name.partition(": ")
    role = "controller" if node == "/mpc" else node.rpartition("/")[2]
    what = {"began": 100.0, "sentence": f"it is {code}", "about": about, **more}
    return {name: StatusDiagnosis(0, node, part, role, code, LEVELS[level], **what)}


class Site:
    """A judge, and the alarms that have begun, changed and ended."""

    def __init__(self) -> None:
        self.judge, self.steady = Judge(), 100.0
        self.changed: list[Alarm] = []

    def passes(self, seconds: float, diagnoses: Wrong, starting: bool = False) -> None:
        """Judge these diagnoses for some seconds, four times in each."""
        for _ in range(max(1, round(4 * seconds))):
            self.steady += 0.25
            self.changed += self.judge.update(
                self.steady, NOON + self.steady, diagnoses, starting=starting
            )

    @property
    def told(self) -> list[tuple[str, str, bool]]:
        """The name and cause of the alarms that changed, and whether they had ended."""
        return [(alarm.name, alarm.follows, alarm.ended is not None) for alarm in self.changed]


def test_an_alarm_begins_and_ends() -> None:
    """Since what its node reports; its duration is by the steady clock, whatever the system's is.

    Other words under the same code are the same alarm; another fault is another one.
    """
    site = Site()
    fault = {"began": -3500.0, "fault": "2310"}
    site.passes(1, wrong("/pump: drive", "drive_fault", **fault))
    site.passes(9, wrong("/pump: drive", "drive_fault", **fault, sentence="for 9 s"))
    (alarm,) = site.judge.present.values()
    assert (alarm.number, alarm.sentence, alarm.since) == (1, "for 9 s", NOON - 3500)
    site.judge.update(111.0, NOON - 7200, {})  # the system's clock was set back
    (alarm,) = site.judge.over
    assert (alarm.ended, alarm.seconds) == (alarm.since, 3611.0)
    for code, number in (("drive_fault", "2310"), ("drive_fault", "2320"), ("drive_lost", "")):
        site.passes(1, wrong("/pump: drive", code, fault=number))
    assert [alarm.number for alarm in site.judge.shown] == [4, 3, 2, 1]


@pytest.mark.parametrize(("code", "seconds"), [
    ("drive_lost", 0), ("a code of another version", 0), ("sensor_lost", 3),
    ("input_publishers", 5),
])
def test_how_long_it_lasts_before_it_is_an_alarm(code: str, seconds: float) -> None:
    """One bad answer of a sensor is none; nor is a restarted one a second publisher."""
    site = Site()
    if seconds:
        site.passes(seconds - 0.25, wrong("/pump: part", code))
        assert not site.changed
    site.passes(0.5, wrong("/pump: part", code))
    assert site.told == [("/pump: part", "", False)]


def test_what_may_still_come_while_a_site_starts_is_only_missing() -> None:
    """It has a minute; what was there is lost, and what no time mends is an alarm at once."""
    site = Site()
    fault = wrong("/pump: pump", "drive_fault")
    site.passes(59, wrong("/pump: drive", "drive_lost") | fault, starting=True)
    assert site.told == [("/pump: pump", "", False)]
    (missing,) = site.judge.missing.values()
    assert (missing.name, missing.number, missing.level) == ("/pump: drive", 0, "warn")
    site.passes(1, wrong("/pump: drive", "drive_lost") | fault)
    lost = Site()
    lost.passes(1, wrong("/pump: drive", "drive_lost", was_good=True), starting=True)
    assert lost.told == site.told[1:] == [("/pump: drive", "", False)]


def test_what_follows_from_another_one() -> None:
    """It waits with its cause until that is an alarm; if the cause ends first, that is a change."""
    site = Site()
    sensor = wrong("/roof_sensor: sensor", "sensor_lost")
    levels = wrong("/pump: levels", "input_silent", "/roof/level")
    site.passes(2, sensor | levels)
    assert not site.changed
    site.passes(2, sensor | levels)
    site.passes(2, levels)
    assert site.told == [
        ("/roof_sensor: sensor", "", False), ("/pump: levels", "/roof_sensor: sensor", False),
        ("/roof_sensor: sensor", "", True), ("/pump: levels", "", False),
    ]
    site.passes(1, {})  # soon after its cause, so it is no event of its own
    assert site.told[-1] == ("/pump: levels", "/roof_sensor: sensor", True)
    site.passes(9, levels)
    site.passes(20, {})
    assert site.told[-1] == ("/pump: levels", "", True)


@pytest.mark.parametrize(("cause", "consequences", "others"), [
    # Of two sensors, the one that publishes the topic; the rest follows from it.
    (wrong("/cistern_sensor", "node_silent", level=STALE),
     wrong("/pump: levels", "input_silent", "/cistern/level")
     | wrong("/mpc: inputs", "input_silent", "/cistern/level")
     | wrong("/pump: pump", "cistern_level_unknown", level=WARN),
     wrong("/roof_sensor: sensor", "sensor_lost")),
    # Without a forecast there is no temperature.
    (wrong("/weather: forecast", "forecast_missing"),
     wrong("/weather: frost", "temperature_unknown")
     | wrong("/pump: frost", "temperature_unknown", "/weather/frost", level=WARN), {}),
    # Frost is told by the weather node, with its temperature.
    (wrong("/weather: frost", "freezing", level=WARN),
     wrong("/pump: pump", "frost", level=WARN) | wrong("/pump: frost", "frost", level=WARN), {}),
    # A node that waits follows from the one it waits for.
    (wrong("/weather", "node_silent", level=STALE),
     wrong("/mpc", "peers_awaited", "weather", level=WARN)
     | wrong("/pump: command", "input_silent", "/pump/command", level=STALE), {}),
    # A drive that is not there explains why nobody knows whether the pump is stopped.
    (wrong("/pump: drive", "drive_lost"), wrong("/pump: pump", "standstill_unknown"),
     # Another node's drive explains nothing.
     wrong("/pump: levels", "input_silent", "/roof/level") | wrong("/valve: drive", "drive_lost")),
    # No error follows from a warning, and a pump that needs a person at it from nothing.
    ({}, {}, wrong("/mpc", "peers_awaited", "plant", level=WARN)
     | wrong("/mpc: inputs", "input_refused", "/roof/level")
     | wrong("/pump: drive", "drive_lost") | wrong("/pump: pump", "hold", level=WARN)),
])
def test_causes(cause: Wrong, consequences: Wrong, others: Wrong) -> None:
    """They do not depend on the order of the reports."""
    expected = dict.fromkeys(consequences, next(iter(cause), ""))
    assert find_causes(cause | consequences | others) == expected
    assert find_causes(others | consequences | cause) == expected


def test_devices_that_fall_silent_together_are_one_alarm() -> None:
    """Behind one broker or line, within seconds; the missing levels follow from it, too."""
    site, broker = Site(), {"line": "192.168.0.2:1883"}
    devices = (
        wrong("/a/roof_sensor: sensor", "broker_lost", **broker)
        | wrong("/a/cistern_sensor: sensor", "sensor_lost", began=101.0, **broker)
        | wrong("/a/pump: drive", "drive_lost", **broker)
    )
    levels = wrong("/a/pump: levels", "input_silent", "/roof/level")
    gauge = wrong("/a/rain_gauge: gauge", "sensor_lost", level=WARN, line="/dev/ttyUSB0")
    site.passes(5, devices | levels | gauge)
    group = "/a/alarms: 192.168.0.2:1883"
    assert {name: alarm.follows for name, alarm in site.judge.present.items()} == {
        group: "", **dict.fromkeys((devices | levels), group), "/a/rain_gauge: gauge": "",
    }
    assert site.judge.present[group].sentence == (
        "cistern sensor, pump and roof sensor fell silent at the same time"
    )
    later = wrong("/a/roof_sensor: sensor", "sensor_lost", began=150.0, **broker)
    site.passes(60, devices | later | wrong("/a/pump: drive", "hold"))
    assert not any(alarm.follows for alarm in site.judge.present.values())


def test_every_code_has_words_for_whoever_stands_at_the_pump() -> None:
    """The headline names labels, no topic or address; the advice no command of ROS and no code."""
    site = Site()
    site.passes(6, wrong("/pump: levels", "input_refused", "/cistern/level", "/roof/level"))
    assert site.changed[0].sentence == "no valid cistern level or roof level arrives"
    for code, condition in read_conditions().items():
        assert not re.search(r"{(topic|problem|why)}|/|%", condition.headline), code
        for role in ("pump", "weather", "controller", "roof_sensor"):
            advice = advise(code, role, "/site1/node")
            assert advice != OTHER and "{" not in advice
            assert not re.search(r"\bros2\b|\b[a-z]+_[a-z]+|\bm3\b", advice), (code, advice)
    assert "greenroof release --namespace site1" in advise("hold", "pump", "/site1/pump")
    leaks = advise("valve_leaks", "valve", "/site1/valve")
    assert "greenroof outlet reset --namespace site1" in leaks
    assert advise("of another version", "pump", "/pump") == OTHER


def test_what_another_program_says_of_an_alarm_is_checked() -> None:
    for broken in ({"number": "x"}, {"since": "now"}, {"seconds": "long"}):
        with pytest.raises(ValueError, match=r"x|now|long"):
            read_status("/pump", 2, "", broken)
