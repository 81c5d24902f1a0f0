"""Totals of gauges and meters: as much water is published as the total has risen by."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from greenroof_ros.live.devices import sensor as devices
from greenroof_ros.live.devices.modbus_line import DriveError
from greenroof_ros.live.devices.sensor import Total
from greenroof_ros.live.devices.sensor_file import MqttSensor

# Time between two looks of a sensor's node (s), and what they may add to the last rise (mm).
LOOK_S = 0.05
LOOK_MM = 1.01 * LOOK_S * 1e-4 / 0.001
# When (s), and the total (mm); None for a lost connection.
Messages = Sequence[tuple[float, float | None]]


def published(
    monkeypatch: pytest.MonkeyPatch, messages: Messages, until: float, *, high: float = 1e-4,
    spread_s: float = float("inf"),
) -> tuple[float, float, int]:
    """Return the integral of the published rate (mm), its maximum, and the number of refusals.

    Args:
        messages: to a gauge that reports mm, in the order of their arrival.
        until: end of the integral (s).
    """
    now = 0.0
    monkeypatch.setattr(devices.time, "monotonic", lambda: now)
    monkeypatch.setattr(devices, "boot_time", lambda: now)
    sensor = MqttSensor(
        address="mqtt://h/t", scale=0.001, low=0.0, high=high, max_age=60.0, counts=True
    )
    gauge, waiting = Total(sensor, "m/s", spread_s), list(messages)
    sum_m, highest, refused, rate = 0.0, 0.0, 0, 0.0
    for look in range(round(until / LOOK_S)):
        sum_m += rate * (look * LOOK_S - now)
        now = look * LOOK_S
        while waiting and waiting[0][0] <= now:
            _, raw = waiting.pop(0)
            try:
                gauge.sensor_lost() if raw is None else gauge.add(raw)
            except DriveError:
                refused += 1
                gauge.sensor_lost()
        rate = gauge.rate() or 0.0
        highest = max(highest, rate)
    assert not waiting
    return sum_m / 0.001, highest, refused


GAUGE, METER = {"high": 1e-4}, {"high": 0.01, "spread_s": 5.0}
HOUR = 3600


@pytest.mark.parametrize(
    ("sensor", "messages", "within", "risen", "highest", "refused"),
    [
        # The gauge starts again: what fell before and after it counts, the fall does not.
        (GAUGE, [(0, 0.4), (10, 0.6), (20, 0.0), (30, 0.2), (40, 0.4)], 100, 0.6, 1e-4, 0),
        # A new gauge, whose total is far higher: nothing of the jump counts.
        (GAUGE, [(0, 17.0), (10, 17.2), (20, 900.0), (30, 900.0), (40, 900.4)], 100, 0.6, 1e-4, 1),
        # The connection is lost for an hour of rain.
        (GAUGE, [(0, 17.0), (30, 17.2), (31, None), (3630, 57.2), (3660, 57.4)],
         HOUR, 40.4, 1e-4, 0),
        # 5.8 mm in 0.6 s after 10 minutes of drizzle: all is published within about a minute.
        (GAUGE, [(0, 0.0), (600, 0.2), (600.5, 5.0), (600.6, 6.0)], 70, 6.0, 1e-4, 0),
        # A water meter after an outage of an hour shows no flow of long ago: a flow while the pump
        # is stopped looks like a welded contact.
        (METER, [(0, 0.0), (1, 3.0), (2, 6.0), (3600, 9006.0), (3603, 9006.0), (3604, 9009.0)],
         100, 9.0, 0.003, 1),
    ],
)
def test_as_much_is_published_as_the_total_rises(
    monkeypatch: pytest.MonkeyPatch, sensor: dict[str, float], messages: Messages, within: float,
    risen: float, highest: float, refused: int,
) -> None:
    result = published(monkeypatch, messages, messages[-1][0] + within, **sensor)
    assert result[0] == pytest.approx(risen, abs=LOOK_MM if sensor is GAUGE else 0.2)
    assert result[1] <= highest * (1 + 1e-9) and result[2] == refused
