"""Relays on MQTT: the driver and its thread, a simulated relay, and a real broker between them.

That the contact opens in time if relay or broker fail is shown by the fault campaign.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from brokers import Mosquitto, Talker, needs_mosquitto
from simulators import Simulator
from simulators import until as wait

from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, DriveSnapshot, read_endpoint

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
    """A relay, a broker, and an exchange that is asked for a speed again and again.

    Attributes:
        speed: the speed asked for, as by the pump node; None for off.
    """

    def __init__(self, make: str, directory: Path) -> None:
        self.broker = Mosquitto(directory)
        self.at = read_endpoint(find_drive_file(make), f"{self.broker.address}/roof", "at")
        self.relay = Simulator(
            "drive_simulator", "--drive", make, "--at", str(self.at), "--timeout", f"{TIMER_S:g}"
        )
        self.exchange = DriveExchange(self.at)
        self.speed: float | None = None
        self._ended = threading.Event()
        self._hand = threading.Thread(target=self._ask, daemon=True)
        self._hand.start()

    def _ask(self) -> None:
        while not self._ended.wait(0.05):
            self.exchange.request_speed(None if self.now.start_failed else self.speed)

    def ask_no_more(self) -> None:
        self._ended.set()
        self._hand.join()

    @property
    def now(self) -> DriveSnapshot:
        return self.exchange.snapshot

    def connect(self) -> None:
        self.exchange.start()
        wait(lambda: self.now.connected)

    @property
    def closed(self) -> bool:
        """Whether the contact is closed."""
        return self.relay.speed() == 1.0

    def run(self) -> None:
        self.connect()
        self.speed = 1.0
        wait(lambda: self.closed and self.now.status and self.now.status.running, 20)

    def close(self) -> None:
        self.ask_no_more()
        self.broker.resume()
        self.exchange.close()
        self.relay.end()
        self.broker.kill()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A Tasmota: what follows from the exchange is the same for each make."""
    with closing(Bench("tasmota", tmp_path)) as bench:
        yield bench


@pytest.mark.parametrize("make", ["shelly_gen2", "tasmota"])
def test_it_is_switched_renewed_and_left_off(make: str, tmp_path: Path) -> None:
    """Off first; *on* is renewed within a third of the timer; no message is retained."""
    with closing(Bench(make, tmp_path)) as bench, Talker(bench.broker, "#") as tap:
        bench.connect()
        assert (bench.now.timeout_s, bench.now.unguarded) == (TIMER_S, None)
        wait(lambda: switched(tap, on=False), 5)
        assert not switched(tap, on=True)
        bench.speed = 1.0
        wait(lambda: bench.closed, 5)
        time.sleep(2 * TIMER_S)
        assert bench.closed and bench.now.problem == ""
        assert len(switched(tap, on=True)) >= 4  # not one each 0.1 s, as it is asked for
        assert len(switched(tap, on=True)) < 20
        bench.ask_no_more()  # like a node that hangs
        wait(lambda: not bench.closed)
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
        bench.run()
        bench.relay.inject("timer_off")
        wait(lambda: not bench.closed)
        tap.received.clear()
        for fault, parameter, note in faults:
            bench.relay.inject(fault, parameter)
            wait(lambda note=note: note in str(bench.now.unguarded))  # type: ignore[misc]
        assert not switched(tap, on=True) and not bench.closed


def test_a_retained_message_is_no_answer(bench: Bench) -> None:
    """Whoever retained it: a Tasmota with PowerRetain, or an old bridge."""
    with Talker(bench.broker) as tap:
        tap.publish("stat/roof/STATUS11", '{"StatusSTS": {"POWER": "ON"}}', retain=True)
        bench.relay.inject("silence")
        bench.exchange.start()
        wait(lambda: "no valid reply with StatusSTS.POWER within 1 s" in bench.now.problem, 10)
        assert not bench.now.connected
