"""The simulated valve of a site without a pump, on a relay at a real broker, by its sensors."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import yaml
from brokers import Talker, mosquitto, needs_mosquitto
from graphs import free_ports
from places import CONFIG
from simulators import Simulator, until

from greenroof_ros.live.devices.modbus_line import ModbusLine, Serial, decode, parse_address
from greenroof_ros.live.simulators.site import LEAK

_KEYS = {"register": 0, "kind": "input", "type": "float32", "word_order": "high first",
         "scale": 1.0, "low": 0.0, "high": 10.0}
_SENSORS = "cistern", "open_switch", "closed_switch"
_OPEN, _CLOSED, _WRONG = (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)
_AREA = 5.0


@needs_mosquitto
@pytest.mark.parametrize(("fault", "on", "off", "flow"), [
    ("", _OPEN, _CLOSED, 0.0),
    ("stuck_open", _OPEN, _OPEN, None),
    ("stuck_closed", _CLOSED, _CLOSED, 0.0),
    ("leak", _OPEN, _CLOSED, LEAK),
    ("wrong_switch", _OPEN, _WRONG, 0.0),
])
def test_it_drains_the_cistern_while_its_relay_is_on(
    fault: str, on: tuple[float, float], off: tuple[float, float], flow: float | None,
    tmp_path: Path,
) -> None:
    """The flow is that through the closed valve; the level falls while the valve is open."""
    (port,) = free_ports(1)
    at = f"tcp://127.0.0.1:{port}"
    (tmp_path / "sensors.yaml").write_text(yaml.safe_dump({
        name: {"address": at, "device_id": number, **_KEYS}
        for number, name in enumerate(_SENSORS, start=1)
    }))
    (tmp_path / "site.yaml").write_text(yaml.safe_dump({
        "extends": str(CONFIG / "site_valve.yaml"), "irrigation": "none", "a1": _AREA,
        "valve_travel_time": 0.9,
    }))

    def read(name: str) -> float:
        serial = Serial(19200, "even", 1, _SENSORS.index(name) + 1)
        line = ModbusLine(parse_address(at), serial, 5.0)
        line.connect()
        words = line.read(0, 2, "input")
        line.close()
        return decode(words, "float32", "high first")

    def switches() -> tuple[float, float]:
        return read("open_switch"), read("closed_switch")

    def outflow() -> float:
        before, began = read("cistern"), time.monotonic()
        time.sleep(3.0)
        return (before - read("cistern")) * _AREA / (time.monotonic() - began)

    with mosquitto(tmp_path) as broker, Talker(broker) as talker, Simulator(
        "simulators site", "--site", str(tmp_path / "site.yaml"), "--hours", "1",
        "--sensors", str(tmp_path / "sensors.yaml"), "--valve-at", f"{broker.address}/valve",
        *(("--valve-fault", fault) if fault else ()),
    ):

        def shows(order: str, shown: tuple[float, float]) -> bool:
            talker.publish("cmnd/valve/Power1", order)
            return switches() == shown

        until(lambda: shows("ON", on), 10)
        time.sleep(1.0)  # a tick with an open valve
        assert shows("ON", on)
        assert (outflow() > 10 * LEAK) == (on == _OPEN)
        until(lambda: shows("OFF", off), 10)
        time.sleep(1.5)
        assert shows("OFF", off)
        if flow is not None:
            assert outflow() == pytest.approx(flow, rel=0.5, abs=1e-7)
