"""The pump node with a simulated relay on MQTT and a real broker, and whatever goes wrong.

The contact's state is read at the simulator's workbench, not from the node.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from brokers import Mosquitto, mosquitto, needs_mosquitto
from graphs import Process, summary_of, wait_for
from paper import PAPER_SITE
from places import CONFIG
from pump_node_rig import PumpRig, SimulatedDrive
from ros_rig import ERROR, OK, Observer

pytestmark = needs_mosquitto

TIMER_S = 3.0
SLACK_S = 2.0


@pytest.fixture
def broker(observer: Observer) -> Iterator[Mosquitto]:
    with mosquitto(observer.cwd) as broker:
        yield broker


class RelayRig(PumpRig):
    """A pump on a relay of this make."""

    def __init__(self, observer: Observer, broker: Mosquitto, make: str, *options: str) -> None:
        super().__init__(observer)
        self.make = make
        self.simulate(
            "--at", f"{broker.address}/roof", *options, make=make,
            pace=("--boot", "0.1", "--timeout", f"{TIMER_S:g}"),
        )

    def begin(self, **parameters: object) -> None:
        self.start(drive=self.make, **parameters)
        self.join()

    def until_closed(self, seconds: float = 60.0) -> float:
        return self.tick_until(1.0, lambda: self.drive.speed() == 1.0, seconds, "a closed contact")

    def until_open(self, seconds: float = 60.0, command: float = 1.0) -> float:
        return self.tick_until(
            command, lambda: self.drive.speed() == 0.0, seconds, "an open contact"
        )


@pytest.mark.parametrize("make", ["shelly_gen2", "tasmota"])
def test_a_command_below_all_is_delivered_in_pulses(
    observer: Observer, broker: Mosquitto, make: str
) -> None:
    """*On* is the whole flow, at most 8.4 l/s here; a tenth of it takes a tenth of the time."""
    rig = RelayRig(observer, broker, make)
    rig.begin(least_on=4.0)
    rig.until_closed()
    assert rig.observer.diagnoses["/pump: drive"].hardware_id.startswith(
        {"tasmota": "Tasmota", "shelly_gen2": "Shelly"}[make]
    )
    rig.until_said("drive timeout", OK, f"the drive stops after {TIMER_S:g} s", command=1.0)
    rig.until_open(command=0.0)
    closed = 0
    for _ in range(300):
        rig.tick(0.1)
        closed += rig.drive.speed() == 1.0
    assert 20 < closed < 45
    assert {round(flow, 4) == 0 or flow > 0.007 for flow in rig.flows} == {True}


def test_a_broker_that_dies_stops_it_and_the_drop_out_counts_as_a_stop(
    observer: Observer, broker: Mosquitto
) -> None:
    """A start is allowed 100 s after a stop, which are 10 s here; the broker is back at once."""
    rig = RelayRig(observer, broker, "tasmota")
    rig.begin(least_off=100.0)
    rig.until_closed()
    broker.kill()
    killed = time.monotonic()
    assert rig.until_open() < TIMER_S + SLACK_S
    rig.until_code("pump", "drive_lost")
    broker.start()
    rig.tick_until(1.0, lambda: rig.code("drive") == "", 30, "the drive")
    rig.until_closed()
    assert time.monotonic() - killed > 9.5


def test_a_relay_that_drops_out_is_said_and_left_off(
    observer: Observer, broker: Mosquitto
) -> None:
    rig = RelayRig(observer, broker, "shelly_gen2")
    rig.begin()
    rig.until_closed()
    rig.drive.inject("deaf")
    assert rig.until_open() < TIMER_S + SLACK_S
    rig.until_code("pump", "second_master", command=1.0)
    assert "its timer has expired" in rig.state
    rig.drive.inject("none")
    rig.until_closed()


@pytest.mark.parametrize(
    ("make", "fault", "words"),
    [
        ("tasmota", "timer_off", "is not effective (PulseTime1.Set is 0: off)"),
        ("tasmota", "timer_long=120", "is 120 s, but must be at most 10 s (drive_timeout_limit)"),
        ("shelly_gen2", "power_up_on", "result.initial_state is on, but must be off"),
    ],
)
def test_one_that_nothing_would_switch_off_is_refused(
    observer: Observer, broker: Mosquitto, make: str, fault: str, words: str
) -> None:
    rig = RelayRig(observer, broker, make, "--fault", fault)
    rig.begin()
    rig.until_said("drive timeout", ERROR, words, command=1.0)
    assert rig.code("drive timeout") == "drive_timeout"
    assert rig.lifecycle_state() != "active"
    assert {rig.tick(1.0) for _ in range(10)} == {0.0}
    assert rig.drive.speed() == 0.0


def test_a_welded_contact_is_an_alarm_that_latches(
    observer: Observer, broker: Mosquitto
) -> None:
    """The flow meter shows 5 l/s although the relay reports *off*."""
    rig = RelayRig(observer, broker, "tasmota")
    site = rig.cwd / "site.yaml"
    site.write_text((CONFIG / "site.yaml").read_text().replace("tau: 1.0 ", "tau: 0.2 "))
    rig.begin(
        live="true", site_file=site, level_limit=1.0, frost_limit=1.0, command_limit=1.0,
        flow_limit=1.0, recovery_time=0.3, follow_time=2.0,
    )
    values = {"/cistern/level": 2.5, "/roof/level": 0.01, "/weather/frost": 0.0,
              "/pump/command": 1.0, "/pump/meter": 0.005}
    rig.play(values, lambda: rig.drive.speed() == 1.0, "a closed contact")
    rig.drive.inject("welded")
    rig.play(
        {**values, "/pump/command": 0.0}, lambda: rig.code("pump") == "runs_on", "the fault", 30
    )
    assert rig.state.startswith("fault") and "perhaps a contact is welded" in rig.state
    assert rig.drive.speed() == 1.0  # nothing here can stop it
    rig.drive.inject("none")
    rig.play({**values, "/pump/meter": 0.0}, lambda: rig.drive.speed() == 0.0, "an open contact")
    assert rig.state.startswith("fault")


def test_check_pump_finds_it_right(observer: Observer, broker: Mosquitto) -> None:
    """At command 1, at which a relay stays on; below it there are pulses."""
    rig = RelayRig(observer, broker, "tasmota")
    rig.leave()
    node = rig.start(drive="tasmota")
    check = Process(
        rig.domain, "check_pump", "--node", "pump", "--period", "0.05", "--command", "1",
        cwd=rig.cwd,
    )
    assert check.wait(180) == 0, check.stdout() + check.stderr()
    assert "22 of 22 checks passed" in check.stdout()
    assert rig.drive.speed() == 0.0
    assert node.wait(60) == 1  # as when a run's plant ends


def test_in_the_loop(domain: int, tmp_path: Path) -> None:
    """In real time, where bringup at once stops the relay of a killed node; and 20 times faster."""
    with mosquitto(tmp_path) as broker:
        relay = SimulatedDrive(
            domain, tmp_path, "--at", f"{broker.address}/roof", make="tasmota",
            pace=("--boot", "0.1", "--timeout", "10"),
        )

        def run(output: str, *options: str) -> Process:
            return Process(
                domain, "bringup", "--output", output, "--drive", "tasmota", "--drive-at",
                relay.address, "--controller", "onoff", "--initial", "low-low", "--state", "kept",
                *options, cwd=tmp_path,
            )

        early = run("early", "--hours", "1")
        wait_for(lambda: relay.speed() == 1.0, 120, "a closed contact")
        os.kill(early.nodes()["pump"], signal.SIGKILL)
        killed = time.monotonic()
        wait_for(lambda: relay.speed() == 0.0, 20, "an open contact")
        assert time.monotonic() - killed < 5.0  # half of the relay's own timer
        assert early.wait(300) == 1
        assert "bringup ordered the drive to stop; it then reported: speed 0.0%" in early.stderr()
        done = run("done", "--hours", "0.05", "--speed", "20")
        assert done.wait(300) == 0, done.stderr()
        # To the target, Eq. (3a), plus 8.4 l/s in the ticks after it.
        summary = summary_of(tmp_path / "done")
        missing = PAPER_SITE.x2_star - summary["initial"]["roof_m3"]
        assert missing < summary["pumped_m3"] < missing + 0.1
        assert relay.speed() == 0.0
        relay.end()
