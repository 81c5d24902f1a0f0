"""Relays on MQTT: the driver and its thread, a simulated relay, and a real broker between them.

That the contact opens in time if relay or broker fail is shown by the fault campaign.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from brokers import Mosquitto, Talker, needs_mosquitto
from simulators import Simulator
from simulators import until as wait

from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint

pytestmark = needs_mosquitto

TIMER_S = 3.0
def switched(tap: Talker, on: bool) -> list[float]:
    """Return when *on* or *off* was ordered."""
    return [
        at for at, topic, payload, _ in tap.received
        if (topic.endswith("/Power1") and payload == ("ON" if on else "OFF"))
        or (topic.endswith("/rpc") and '"Switch.Set"' in payload
            and json.loads(payload)["params"]["on"] is on)
    ]


class Bench:
    """A relay, a broker, and an exchange.

    Attributes:
        speed: what is asked for again and again, as by the pump node; None for off.
    """

    def __init__(self, make: str, directory: Path) -> None:
        self.broker = Mosquitto(directory)
        self.at = read_endpoint(find_drive_file(make), f"{self.broker.address}/roof", "at")
        self.relay = Simulator(
            "drive_simulator", "--drive", make, "--at", str(self.at), "--timeout", f"{TIMER_S:g}"
        )
        self.exchange = DriveExchange(self.at)
        self.speed: float | None = None

    def until(self, condition: Callable[[], object]) -> None:
        """Ask for the speed until a condition holds; after a failed start, for off."""
        wait(lambda: self.exchange.request_speed(
            None if self.exchange.snapshot.start_failed else self.speed
        ) or condition())

    @property
    def closed(self) -> bool:
        """Whether the contact is closed."""
        return self.relay.speed() == 1.0

    def close(self) -> None:
        self.exchange.close()
        self.relay.end()
        self.broker.kill()


@pytest.mark.parametrize("make", ["shelly_gen2", "tasmota"])
def test_it_is_switched_renewed_and_left_off(make: str, tmp_path: Path) -> None:
    """Off first; *on* is renewed in time, not as often as asked for; no message is retained."""
    with closing(Bench(make, tmp_path)) as bench, Talker(bench.broker, "#") as tap:
        bench.exchange.start()
        bench.until(lambda: bench.exchange.snapshot.connected and switched(tap, on=False))
        now = bench.exchange.snapshot
        assert (now.timeout_s, now.unguarded, switched(tap, on=True)) == (TIMER_S, None, [])
        bench.speed = 1.0
        bench.until(lambda: bench.closed)
        ended = time.monotonic() + 2 * TIMER_S
        bench.until(lambda: time.monotonic() > ended)
        assert bench.closed and bench.exchange.snapshot.problem == ""
        assert 4 <= len(switched(tap, on=True)) < 20
        wait(lambda: not bench.closed)  # asked no more, as by a node that hangs
        bench.exchange.close()
        assert "speed 0.0%, off" in bench.exchange.outcome()
        with Talker(bench.broker) as late:
            time.sleep(0.5)
            assert late.received == []


@pytest.mark.parametrize(("make", "faults"), [
    ("tasmota", [
        ("timer_off", 0, "PulseTime1.Set is 0"), ("timer_long", 2, "PulseTime1.Set is 20"),
        ("timer_long", 12, "PulseTime1.Set is 1"), ("power_up_on", 0, "PowerOnState is 3"),
    ]),
    ("shelly_gen2", [
        ("timer_off", 0, "result.auto_off is false"), ("timer_long", 2, "auto_off_delay is 2"),
        ("power_up_on", 0, "initial_state is on"), ("auto_on", 0, "result.auto_on is true"),
    ]),
])
def test_one_that_nothing_would_switch_off_is_not_switched_on(
    make: str, faults: list[tuple[str, int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is switched off while on; the settings are read again, here every 0.3 s."""
    monkeypatch.setattr("greenroof_ros.live.devices.exchange.MAX_RAMP_S", 0.3)
    with closing(Bench(make, tmp_path)) as bench, Talker(bench.broker, "#") as tap:
        bench.exchange.start()
        bench.speed = 1.0
        bench.until(lambda: bench.closed)
        bench.relay.inject("timer_off")
        bench.until(lambda: not bench.closed)
        tap.received.clear()
        for fault, parameter, note in faults:
            bench.relay.inject(fault, parameter)
            bench.until(lambda note=note: note in str(bench.exchange.snapshot.unguarded))  # type: ignore[misc]
        assert not switched(tap, on=True) and not bench.closed


def test_a_retained_message_is_no_answer(tmp_path: Path) -> None:
    """Whoever retained it: a Tasmota with PowerRetain, or an old bridge."""
    with closing(Bench("tasmota", tmp_path)) as bench, Talker(bench.broker) as tap:
        tap.publish("stat/roof/STATUS11", '{"StatusSTS": {"POWER": "ON"}}', retain=True)
        bench.relay.inject("silence")
        bench.exchange.start()
        wait(lambda: "no valid reply with StatusSTS.POWER" in bench.exchange.snapshot.problem)
        assert not bench.exchange.snapshot.connected
