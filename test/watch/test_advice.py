"""Advice on the sentences that the parts of this package say themselves, each made to say them."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from modbus_wire import Answer, Wire, acs880
from paper import PAPER_SITE
from pump_rig import Rig

from greenroof_ros.common.times import boot_time
from greenroof_ros.drives.level_sensor import LevelSensor
from greenroof_ros.drives.modbus_line import DriveError
from greenroof_ros.drives.sensor_file import Sensor
from greenroof_ros.forecast.live_forecast import ForecastFile, LiveForecast, NoForecastError
from greenroof_ros.graph.supervision import PERMIT_PIPE, Permit, PermitReader
from greenroof_ros.pumping.input_rules import InputRules, LevelRule, cistern_reach
from greenroof_ros.pumping.ledger import Ledger
from greenroof_ros.pumping.limits import settings_for
from greenroof_ros.watch.advice import FOREIGN, OTHER, advise


def on_pump(part: str, message: str) -> str:
    return advise("/pump", "pump", part, message)


# --- the pump's state and limits ------------------------------------------------------------------


def rig_that(**change: Any) -> Rig:
    """Return a rig whose pump ran, and then saw what is given."""
    rig = Rig()
    rig.run(15, 1.0)
    rig.change = change
    rig.run(3, 1.0)
    return rig


def fault(seconds: float, command: float, **broken: Any) -> Rig:
    """Return a rig in which something breaks when it has run, until its fault."""
    rig = Rig(x2=0.5)
    rig.run(600, 0.01)
    for name, value in broken.items():
        setattr(rig, name, value)
    rig.run(seconds, command, until=lambda one: one.state == "fault")
    return rig


@pytest.mark.parametrize(("seconds", "command", "broken", "advice"), [
    (900, 1.0, {"arriving": 0.0}, "Water leaves the cistern"),
    (900, 1.0, {"arriving": 0.0, "leaving": 0.0}, "The pump runs and moves"),
    (600, 0.0, {"contactor_stuck": True}, "The pump turns although"),
    (4000, 0.3, {"leak": 0.01}, "The cistern loses more water"),
    (900, 1.0, {"leaving": 0.0}, "Water arrives on the roof and the cistern"),
], ids=["burst pipe", "closed valve", "contactor", "leak", "stuck cistern"])
def test_what_the_levels_show(
    seconds: float, command: float, broken: dict[str, Any], advice: str
) -> None:
    """On the other interlocks see test_interlocks.py."""
    message = f"fault: {fault(seconds, command, **broken).decisions[-1].why}"
    assert on_pump("pump", message).startswith(advice), message


@pytest.mark.parametrize(("why", "advice"), [
    ("the pump still turns, at 0.80 of its speed", "Somebody stopped the pump, and it still turns"),
    ("whether the pump stands is not known", "The drive is not heard, and whether"),
])
def test_a_stopped_pump_that_may_turn_is_not_to_be_released(why: str, advice: str) -> None:
    """What the pump node says then is that of PumpControl: see its tests."""
    assert on_pump("pump", f"held: an operator stopped it; {why}").startswith(advice)


def test_every_warning_about_the_pumps_limits() -> None:
    """A command above 1, a meter that says too much, and a debt that cannot be paid."""
    debt = Rig(settings=settings_for(PAPER_SITE, starts_per_hour=1.0))
    debt.run(7200, 0.02)
    for rig, advice in (
        (rig_that(command=1.5), "The controller asks for more"),
        (rig_that(flow=5.0), "The flow meter reads more"),
        (debt, "The pump lags behind"),
    ):
        warnings = [one.warning for one in rig.decisions if one.warning]
        assert warnings
        assert {on_pump("limits", one)[:len(advice)] for one in warnings} == {advice}


# --- inputs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("role", "part"), [("pump", "levels"), ("controller", "inputs")])
def test_every_rule_of_a_level(role: str, part: str) -> None:
    def rules() -> InputRules:
        return InputRules(0.0, 5.0, 10.0, level=LevelRule(cistern_reach(PAPER_SITE), 0.01, 0.02))

    waiting, silent, unit, jump, frozen, paused, recovering = (rules() for _ in range(7))
    for one in (silent, jump, frozen, paused):
        one.came(0.0, 2.0)
        one.judge(11.0 if one is silent else 0.1)
    unit.came(0.0, 81.0)
    for now in range(1, 13):
        for one in (jump, frozen):
            one.came(float(now), 2.0)
    jump.came(13.0, 5.0)
    frozen_rule = LevelRule(cistern_reach(PAPER_SITE), 0.01, 0.02)
    frozen_rule.came(0.0, 2.0)
    frozen_rule.expect(-0.02)
    paused.paused(5.0, 3.0)
    recovering.came(0.0, 2.0)
    recovering.judge(7.0)
    recovering.came(8.0, 2.0)
    for verdict, advice in (
        (waiting.judge(1.0), "A water level is not known"),
        (silent.judge(12.0), "A water level is not known"),
        (unit.judge(0.5), "A level is higher than its tank"),
        (jump.judge(13.1), "A level moved faster than water can"),
        (frozen_rule.came(1.0, 2.0), "A level sensor repeats"),
        (paused.judge(5.1), "The computer was too busy"),
        (recovering.judge(8.1), "It is good again"),
        (silent.judge(13.0, "has 2 publishers (a, b), and must have one"), "Two programs do"),
    ):
        message = f"/cistern/level {verdict.why}"
        assert advise("/x", role, part, message).startswith(advice), message


def test_bringups_permit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a real pipe: what it says, that it says nothing, and that it has ended."""
    permit = Permit()
    monkeypatch.setenv(PERMIT_PIPE, str(permit.open()[PERMIT_PIPE]))
    reader = PermitReader()
    said = [reader.missing(boot_time())]
    permit.tell("cistern_sensor is missing, mpc waits for weather")
    now = boot_time()
    said += [reader.missing(now), reader.missing(now + 3.0)]
    permit.close()
    said.append(reader.missing(now))
    program, site = "The program that watches over", "A program of the site is not there"
    for hold, advice in zip(said, (program, site, program, program), strict=True):
        assert on_pump("supervisor", hold).startswith(advice), hold
        assert on_pump("pump", f"off: {hold}").startswith(advice), hold


# --- state file -----------------------------------------------------------------------------------


def test_a_state_file_that_is_not_kept(tmp_path: Path) -> None:
    """Another process has it; its directory cannot be made; it cannot be read."""
    first = Ledger(tmp_path / "state.json", time.time)
    second = Ledger(tmp_path / "state.json", time.time)
    (tmp_path / "file").write_text("")
    nowhere = Ledger(tmp_path / "file" / "state.json", time.time)
    (tmp_path / "broken.json").write_text("{")
    broken = Ledger(tmp_path / "broken.json", time.time)
    try:
        taken, unwritable = second.why_not_kept(), nowhere.why_not_kept()
        assert on_pump("state file", taken).startswith("Two programs for the same pump")
        assert on_pump("state file", unwritable).startswith("A stop would be forgotten")
        why = f"held: {broken.record.unknown}"
        assert on_pump("pump", why).startswith("What the pump's program had noted is lost")
    finally:
        for one in (first, second, nowhere, broken):
            one.close()


# --- the drive, over a real port ------------------------------------------------------------------


@pytest.fixture
def wire() -> Iterator[Wire]:
    wire = Wire(acs880())
    yield wire
    wire.close()


def drive_at(address: str) -> Any:
    """Return what the pump node knows of its drive, which it calls."""
    pump = pytest.importorskip("greenroof_ros.nodes.pump", reason="nodes need ROS 2")
    drive = pump._Drive({
        "drive": "abb_acs880", "address": address, "exchange_period": 0.05,
        "drive_timeout_limit": 10.0, "activate_without_drive_timeout": False,
        "local_settings_stop_the_pump": False,
    }, "pump")
    drive.connect()
    return drive


def absence(drive: Any, words: str) -> str:
    """Return why the drive is not heard, once that has the words."""
    until = time.monotonic() + 60
    while words not in (why := drive.absence(boot_time())):
        assert time.monotonic() < until, why
        time.sleep(0.01)
    return str(why)


def silent(_: bytes) -> Answer:
    return []


def test_a_drive_that_is_not_there_and_one_that_somebody_has(wire: Wire) -> None:
    nowhere = Wire(silent)
    nowhere.close()
    first, second = drive_at(wire.gateway), drive_at(nowhere.gateway)
    try:
        absence(first, "")
        assert on_pump("drive", absence(second, "cannot connect")).startswith("The drive is not")
        third = drive_at(wire.gateway)
        try:
            why = absence(third, "already")
            assert on_pump("drive", why).startswith("Another program on this computer"), why
        finally:
            third.exchange.close()
    finally:
        for one in (first, second):
            one.exchange.close()


# --- sensors and the weather ----------------------------------------------------------------------


@pytest.mark.parametrize(("data", "advice", "given"), [
    ("ffff", "The level sensor answers, but", {}),
    ("7fff", "The level sensor answers, but", {"missing": 0x7FFF}),
    ("7fc00000", "The level sensor answers, but", {"type": "float32"}),
    ("00", "The level sensor does not answer", {}),
    ("", "The level sensor does not answer", {}),
])
def test_a_level_sensor(data: str, advice: str, given: dict[str, Any]) -> None:
    """It says what cannot be, too little, or nothing."""

    def answer(request: bytes) -> Answer:
        rest = request[6:8] + bytes([len(data) // 2]) + bytes.fromhex(data)
        return [(0.0, request[:4] + len(rest).to_bytes(2, "big") + rest)] if data else []

    wire = Wire(answer)
    values: dict[str, Any] = {
        "address": wire.at, "device_id": 1, "register": 16, "kind": "input", "type": "uint16",
        "scale": 1e-4, "low": 0.0, "high": 6.0, "median": 1, "period": 0.05,
    }
    sensor = LevelSensor(Sensor(**{**values, **given}), timeout_s=0.3)
    try:
        with pytest.raises(DriveError) as caught:
            sensor.read()
    finally:
        wire.close()
    for tank in ("cistern", "roof"):
        found = advise(f"/{tank}_sensor", f"{tank}_sensor", "sensor", str(caught.value))
        assert found.startswith(advice), str(caught.value)


def test_a_forecast_that_is_not_there(tmp_path: Path) -> None:
    """Missing, ahead, old, too short."""
    file, said = tmp_path / "forecast.csv", set()
    issued = datetime(2026, 7, 1, 6, tzinfo=UTC)
    for now, hours in ((0, 0), (-1, 200), (100, 200), (1, 2)):
        lines = ["issued,time,precipitation [mm/h],evapotranspiration [mm/day],temperature [degC]"]
        lines += [
            f"{issued.isoformat()},{(issued + timedelta(hours=hour)).isoformat()},0,2,15"
            for hour in range(hours)
        ]
        if hours:
            file.write_text("\n".join(lines) + "\n")
        forecast = LiveForecast(ForecastFile(file), PAPER_SITE, 12.0, 7200.0, all_members=False)
        forecast.file.look()
        with pytest.raises(NoForecastError) as caught:
            forecast.at(issued + timedelta(hours=now))
        said.add("; ".join(filter(None, [str(caught.value), forecast.file.problem])))
    assert len(said) == 4
    for message in said:
        advice = advise("/weather", "weather", "forecast", message)
        assert advice.startswith("There is no forecast for now"), message


# --- what was said in the campaign of faults ------------------------------------------------------


def heard() -> list[tuple[str, str, str]]:
    """Return what nodes said in cases of the campaign, each sentence once but for its numbers."""
    lines = Path(__file__).with_name("said_in_faults.jsonl").read_text().splitlines()
    return [tuple(json.loads(line)) for line in lines]


def test_there_is_advice_on_all_that_was_said_in_the_campaign() -> None:
    said = heard()
    assert len(said) > 80
    without = [one for one in said if advise("/x", *one) in (OTHER, FOREIGN)]
    assert without == []


def test_a_node_that_was_started_again_needs_nothing() -> None:
    """As an incident has it."""
    for cause in ("ended (SIGKILL); starts again in 1 s", "is missing; starts again in 2 s"):
        assert "bringup started it again" in advise("/mpc", "mpc", "process", cause)


def test_of_other_devices_nothing_is_known() -> None:
    assert advise("/camera", "", "lens", "fault: an operator stopped it") == FOREIGN
    assert advise("/x", "gauge", "battery", "low") == OTHER
