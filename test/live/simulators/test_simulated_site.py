"""The simulated site: two tanks with level sensors, in process; and as a program with a drive."""

from __future__ import annotations

import signal
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from brokers import mosquitto, needs_mosquitto
from graphs import Process, free_ports
from paper import PAPER_SITE
from places import CONFIG
from simulators import Simulator, until

from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.exchange import DriveExchange, read_endpoint
from greenroof_ros.live.devices.sensor import ModbusReader, MqttReader, SensorLine
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, read_sensors
from greenroof_ros.live.simulators.site import SimulatedSite

SENSORS = read_sensors(CONFIG / "sensors.yaml")


def test_levels_move_by_the_volume_that_the_drives_speed_stands_for() -> None:
    """At 0.8 of rated speed, by hand, Eqs. (3b) and (3c) with the affinity laws.

    Head 0.64 x 55.2 + 3 - 16 = 22.328 m; resistance (3.56 x 18.4 / 0.2 + 0.6) / (2 x 9.81 x
    0.0314159^2) + 5.78e5 = 594945 s2/m5; flow (22.328 / 594945)^0.5 = 6.1261e-3 m3/s. In 40 s that
    is 0.2450 m3, and the level falls by 9.8 mm on 25 m2, which reduces the flow by 0.02 %; the roof
    of 68.8 m2 rises by 3.56 mm, and by 9e-6 m each second: 36 mm/h is 1e-5 m/s, 86.4 mm a day 1e-6
    m/s. The sensors have counts of 0.1 mm.
    """
    site = SimulatedSite(
        PAPER_SITE, [1e-5], [1e-6 * PAPER_SITE.a2], (75.0, 3.44), SENSORS, lambda: 0.8
    )
    for _ in range(40):
        site.step(0.8, site.flow(0.8))
    ticks, (cistern, roof) = site.virtual_site.tick, site.virtual_site.levels()
    assert site.pumped == pytest.approx(6.1261e-3 * ticks, rel=5e-4)
    assert cistern == pytest.approx(3 - site.pumped / 25, abs=1e-5)
    assert roof == pytest.approx(0.05 + site.pumped / 68.8 + ticks * 9e-6, abs=1e-5)
    read = [site.words(name, SENSORS.by_section[name])[0] for name in ("cistern", "roof")]
    assert read == pytest.approx([1e4 * cistern, 1e4 * roof], abs=1)


def read_once(sensor: ModbusSensor) -> float:
    """Return what a sensor on Modbus reads."""
    with closing(ModbusReader("roof", sensor, SensorLine(), 5.0)) as reader:
        reader.start()
        until(lambda: reader.snapshot.value is not None, 20)
        assert reader.snapshot.value is not None
        return reader.snapshot.value


@needs_mosquitto
def test_sensors_on_mqtt_next_to_one_on_modbus(tmp_path: Path) -> None:
    """The roof's 3.44 m3 are 5 cm on 68.8 m2; 36 mm/h are 1e-5 m/s, counted tick by tick."""
    file, (port,) = tmp_path / "sensors.yaml", free_ports(1)
    modbus = (CONFIG / "sensors.yaml").read_text().partition("\nroof:")[0]
    mqtt = "roof:" + (CONFIG / "sensors_mqtt.yaml").read_text().partition("\nroof:")[2]
    with mosquitto(tmp_path) as broker, ExitStack() as stack:
        file.write_text(f"{modbus}\n{mqtt}".replace(":5030", f":{port}").replace(
            "mqtt://127.0.0.1:1883", broker.address).replace("max_age: 60.0", "max_age: 10.0"))
        stack.enter_context(Simulator(
            "site_simulator", "--sensors", str(file), "--workbench", "0", "--cistern", "50",
            "--roof", "3.44", "--rain", "36", "--constant-evapotranspiration", "0",
        ))
        sensors, readers = read_sensors(file), {}
        for section in ("roof", "rain_gauge", "thermometer"):
            sensor = sensors.by_section[section]
            assert isinstance(sensor, MqttSensor)
            readers[section] = stack.enter_context(closing(MqttReader(section, sensor)))
            readers[section].start()
        assert isinstance(sensors.cistern, ModbusSensor)
        assert read_once(sensors.cistern) == pytest.approx(2.0, abs=1e-3)
        until(lambda: all(reader.snapshot.value for reader in readers.values()), 20)
        assert readers["roof"].snapshot.value == pytest.approx(0.05, abs=5e-4)
        assert readers["rain_gauge"].snapshot.value == pytest.approx(1e-5, rel=0.6)
        assert readers["thermometer"].snapshot.value == 15.0


def test_one_command_is_a_site_with_its_drive(tmp_path: Path) -> None:
    """The pump node's exchange runs the pump, and the cistern's sensor shows it; then Ctrl-C."""
    cistern, roof, port = free_ports(3)
    file = tmp_path / "sensors.yaml"
    text = (CONFIG / "sensors.yaml").read_text()
    file.write_text(text.replace(":5030", f":{cistern}").replace(":5031", f":{roof}"))
    at = f"gateway://127.0.0.1:{port}"
    site = Process(
        0, "simulators", "--sensors", str(file), "--at", at, "--initial", "high-low", cwd=tmp_path
    )
    until(lambda: "ready: " in site.stdout())
    sensor = read_sensors(file).cistern
    assert isinstance(sensor, ModbusSensor)
    before = read_once(sensor)
    endpoint = read_endpoint(find_drive_file("danfoss_fc202"), at, "at")
    with closing(DriveExchange(endpoint)) as exchange:
        exchange.start()
        until(lambda: exchange.request_speed(1.0) or read_once(sensor) < before - 0.002, 30)
    site.process.send_signal(signal.SIGINT)
    assert site.process.wait(30) == 0, site.stderr()
