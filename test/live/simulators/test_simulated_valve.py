"""The simulated valve by itself; its relay, sensors and flows are shown by the fault campaign."""

from __future__ import annotations

import time

import pytest

from greenroof_ros.live.simulators.valve import SimulatedValve

_OPEN, _CLOSED, _WRONG = (1, 0), (0, 1), (1, 1)


@pytest.mark.parametrize(("fault", "on", "off"), [
    ("", _OPEN, _CLOSED), ("leak", _OPEN, _CLOSED), ("wrong_switch", _OPEN, _WRONG),
    ("stuck_open", _OPEN, _OPEN), ("stuck_closed", _CLOSED, _CLOSED),
])
def test_it_follows_its_relay_within_its_travel_time_unless_it_is_stuck(
    monkeypatch: pytest.MonkeyPatch, fault: str, on: tuple[int, int], off: tuple[int, int]
) -> None:
    """Shown by the switches for open and for closed."""
    now, relay = 0.0, False
    monkeypatch.setattr(time, "monotonic", lambda: now)
    valve = SimulatedValve(lambda: relay, 30.0, fault)
    for relay, expected in ((True, on), (False, off)):  # noqa: B007
        now += 15.0
        assert fault or valve.advance() == pytest.approx(0.5)
        now += 15.1
        valve.advance()
        assert (*valve.switches().values(),) == expected
