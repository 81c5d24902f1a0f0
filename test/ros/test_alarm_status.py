"""An alarm as a status on /alarms, which every observer shows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greenroof_ros.interface.alarm import Alarm
from greenroof_ros.ros.alarm_status import read_status, to_status

FROST = Alarm(
    7, "/site1/pump", "inputs", "pump", "input_silent", "error", "the roof sensor is silent",
    since=1_700_000_000.0, follows="/site1/roof_sensor: sensor", about=("/roof/level", "/x"),
    fault="F 7",
)


def test_status_and_back() -> None:
    """A status has the level as now, and plain values; what does not apply is left out."""
    level, values = to_status(FROST)
    assert level == 2
    assert values == {
        "number": "7", "role": "pump", "code": "input_silent", "fault": "F 7",
        "since": "2023-11-14T22:13:20.000+00:00", "follows": "/site1/roof_sensor: sensor",
        "about": "/roof/level /x", "serious": "true",
    }
    assert read_status("/site1/pump: inputs", level, FROST.sentence, values) == FROST


@pytest.mark.parametrize(("level", "role"), [("error", "pump"), ("warn", "pump"), ("warn", "")])
def test_over(level: str, role: str) -> None:
    """An alarm that is over has the level OK, with its end and duration."""
    over = replace(FROST, level=level, role=role, ended=1_700_000_060.0, seconds=60.5)
    now, values = to_status(over)
    assert (now, values["ended"], values["seconds"]) == (0, "2023-11-14T22:14:20.000+00:00", "60.5")
    assert read_status(over.name, now, over.sentence, values) == over


def test_missing_while_starting() -> None:
    """What may still come has no number."""
    missing = replace(FROST, number=0, level="warn")
    level, values = to_status(missing)
    assert level == 1
    assert values["starting"] == "true"
    assert "number" not in values
    assert read_status(missing.name, level, missing.sentence, values) == missing


@pytest.mark.parametrize("values", [{"number": "x"}, {"since": "now"}, {"seconds": "long"}])
def test_invalid_values(values: dict[str, str]) -> None:
    """Any program may publish on the topic."""
    with pytest.raises(ValueError, match=r"x|now|long"):
        read_status("/pump", 2, "", values)
