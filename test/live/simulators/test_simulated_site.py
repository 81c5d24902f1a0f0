"""The simulated site: two tanks with level sensors, in process; and as a program with a drive."""

from __future__ import annotations

import asyncio
import csv
import signal
import time
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest
from brokers import mosquitto, needs_mosquitto
from graphs import Process, free_ports
from paper import PAPER_SITE
from places import CONFIG
from rig_simulators import DEFAULT, SiteBench
from simulators import Simulator, until

from greenroof_ros.live.devices.drive_file import find_drive_file
from greenroof_ros.live.devices.endpoint import read_endpoint
from greenroof_ros.live.devices.exchange import DriveExchange
from greenroof_ros.live.devices.modbus_line import Address
from greenroof_ros.live.devices.modbus_sensor import ModbusReader, SensorLine
from greenroof_ros.live.devices.mqtt_sensor import MqttReader
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, Sensors, read_sensors

SENSORS = read_sensors(CONFIG / "sensors.yaml")


def site_of(rain: float, sensors: Sensors = SENSORS) -> SiteBench:
    """Return a site with 2 m in the cistern and 5 cm on the roof, a thousand times as fast."""
    return SiteBench(
        PAPER_SITE, [rain], [0.0], (50.0, 3.44), sensors, Address("127.0.0.1", 0), factor=1000.0
    )


def run_to(bench: SiteBench, tick: int) -> None:
    """Let time pass until at least this tick."""

    async def passing() -> None:
        ended = asyncio.Event()
        running = asyncio.create_task(bench.run(ended))
        while bench.site.tick < tick:
            await asyncio.sleep(0.001)
        ended.set()
        await running

    asyncio.run(passing())


def test_levels_move_by_the_volume_that_the_drives_speed_stands_for(tmp_path: Path) -> None:
    """At 0.8 of rated speed, by hand, Eqs. (3b) and (3c) with the affinity laws.

    Head 0.64 x 55.2 + 3 - 16 = 22.328 m; resistance (3.56 x 18.4 / 0.2 + 0.6) / (2 x 9.81 x
    0.0314159^2) + 5.78e5 = 594945 s2/m5; flow (22.328 / 594945)^0.5 = 6.1261e-3 m3/s. In 40 s that
    is 0.2450 m3, and the level falls by 9.8 mm on 25 m2, which reduces the flow by 0.02 %; the roof
    of 68.8 m2 rises by 3.56 mm, and by 9e-6 m each second: 36 mm/h is 1e-5 m/s, 86.4 mm a day 1e-6
    m/s. The rain on the cistern's inlet is 2.9e-6 m3/s.
    """
    cistern, roof = free_ports(2)
    file, table = tmp_path / "sensors.yaml", tmp_path / "levels.csv"
    text = (CONFIG / "sensors.yaml").read_text()
    # And a flow meter in L/min, behind the cistern's port.
    meter = (
        f"flow_meter: {{address: 'tcp://127.0.0.1:{cistern}', device_id: 2, register: 4, "
        "kind: input, type: float32, word_order: high first, scale: 1.6666667e-5, low: 0, "
        "high: 1}\n"
    )
    text = text.replace(":5030", f":{cistern}").replace(":5031", f":{roof}")
    file.write_text(text + meter)
    sensors = read_sensors(file)

    def rows() -> list[dict[str, float]]:
        """Return the complete rows of the table, without the name of the fault."""
        lines = table.read_text().rpartition("\n")[0].splitlines()
        return [
            {key: float(value) for key, value in row.items() if key != "fault"}
            for row in csv.DictReader(lines)
        ]

    def at_tick(tick: int) -> dict[str, float]:
        until(lambda: len(rows()) >= tick, 10)
        return rows()[tick - 1]

    with Simulator(
        "drive_simulator", "--drive", "abb_acs880", "--port", "0", "--workbench", "0", "--fault",
        "stuck_running=8000",
    ) as drive:
        until(lambda: drive.speed() == pytest.approx(0.8))
        # The cistern is full up to its outlet at 3 m, the roof is at 5 cm.
        with Simulator(
            "site_simulator", "--sensors", str(file), "--workbench", "0", "--output", str(table),
            "--cistern", "75", "--roof", "3.44", "--rain", "36", "--constant-evapotranspiration",
            "86.4", "--drive-at", drive.workbench, "--factor", "40",
        ) as site:
            first, last = at_tick(1), at_tick(40)
            earlier = rows()[-1]
            levels = [
                read_once(sensor) for sensor in sensors.by_section.values()
                if isinstance(sensor, ModbusSensor)
            ]
            now = rows()[-1]
            site.inject("burst_pipe")
            time.sleep(0.1)
            before = rows()[-1]
            after = at_tick(round(before["time_s"]) + 20)
            drive.inject("none")  # the motor coasts
            until(lambda: rows()[-1]["pump_flow_m3_per_s"] == 0)
            drive.end()
            until(lambda: rows()[-1]["speed"] == 0)
        assert "the pump is assumed to be stopped" in site.output
    assert (first["time_s"], last["time_s"]) == (1, 40)
    assert first["pump_flow_m3_per_s"] == pytest.approx(6.1261e-3, rel=1e-4)
    assert last["pumped_m3"] == pytest.approx(0.2450, rel=5e-4)
    assert last["cistern_level_m"] == pytest.approx(3 - 0.2450 / 25, abs=1e-5)
    assert last["roof_level_m"] == pytest.approx(0.05 + 0.2450 / 68.8 + 40 * 9e-6, abs=1e-5)
    # Through a burst pipe water leaves the cistern and does not arrive.
    pumped = after["pumped_m3"] - before["pumped_m3"]
    assert pumped > 0.1
    assert after["roof_level_m"] - before["roof_level_m"] == pytest.approx(20 * 9e-6, rel=1e-3)
    assert before["cistern_level_m"] - after["cistern_level_m"] == pytest.approx(
        (pumped - 20 * 2.922467e-6) / 25, rel=1e-5
    )
    # The readings are of a tick between these two; a level moves by 2.5e-4 m in a tick.
    assert now["cistern_level_m"] - 8e-4 < levels[0] < earlier["cistern_level_m"] + 8e-4
    assert earlier["roof_level_m"] - 4e-4 < levels[1] < now["roof_level_m"] + 4e-4
    assert levels[2] == pytest.approx(6.1261e-3, rel=1e-3)


def read_once(sensor: ModbusSensor) -> float:
    """Return what a sensor on Modbus reads."""
    with closing(ModbusReader(sensor, "m", SensorLine(sensor.address))) as reader:
        reader.start()
        until(lambda: reader.snapshot.value is not None, 20)
        assert reader.snapshot.value is not None
        return reader.snapshot.value


def test_a_leak() -> None:
    """2000 ml/s from 25 m2 are 0.08 mm/s."""
    bench = site_of(0.0)
    bench.inject("leak", 2000)
    run_to(bench, 200)
    assert bench.site.plant.levels()[0] == pytest.approx(2 - bench.site.tick * 8e-5, rel=1e-9)
    assert bench.site.pumped == 0


def test_sensor_faults_change_what_one_sensor_reports_and_no_level() -> None:
    """The roof rises by 1 count (0.1 mm) in 2 s of rain at 180 mm/h."""
    bench = site_of(5e-5)
    cistern, roof = (server.devices[1] for server in bench.servers)

    def error() -> float:
        """Return the error of the roof's sensor (counts)."""
        return roof.read()[0] - bench.site.plant.levels()[1] * 1e4

    run_to(bench, 20)
    assert error() == pytest.approx(0, abs=1)
    bench.inject("roof_frozen", DEFAULT)
    frozen, began = roof.read()[0], bench.site.tick
    run_to(bench, began + 40)
    assert roof.read()[0] == frozen
    assert error() == pytest.approx((began - bench.site.tick) / 2, abs=1)
    bench.inject("roof_absurd", 1234)
    assert roof.read()[0] == 1234
    bench.inject("roof_noisy", 200)
    errors = [error() for _ in range(40)]
    assert 60 < max(errors) < 1200 and -1200 < min(errors) < -60
    bench.inject("roof_drifting", 600)  # 10 counts a second of the site's time
    began = bench.site.tick
    run_to(bench, began + 60)
    assert error() == pytest.approx(10 * (bench.site.tick - began), abs=1)
    bench.inject("roof_silent", DEFAULT)
    assert (cistern.on_request(0), roof.on_request(0)) == (True, False)
    assert cistern.read()[0] == pytest.approx(20000, abs=5)
    bench.inject("none", DEFAULT)
    assert error() == pytest.approx(0, abs=1)


def test_both_sensors_may_be_on_one_line() -> None:
    """Devices 1 and 2 behind one port, as on a serial line with a gateway; one can be silent."""
    on_it = replace(SENSORS.roof, address=SENSORS.cistern.address, device_id=2)
    bench = site_of(0.0, replace(SENSORS, roof=on_it))
    (server,) = bench.servers
    assert [server.devices[number].read()[0] for number in (1, 2)] == [20000, 500]
    bench.inject("cistern_silent", DEFAULT)
    assert [server.devices[number].on_request(0) for number in (1, 2)] == [False, True]


def test_a_moisture_probe_reads_the_water_of_the_roof_per_volume_of_its_substrate() -> None:
    """5 cm in a substrate of 0.5 m are 0.1 m3/m3: 100 counts of 0.1 %."""
    probe = replace(SENSORS.roof, scale=0.001, substrate_depth=0.5, high=0.5)
    _, roof = site_of(0.0, replace(SENSORS, roof=probe)).servers
    assert roof.devices[1].read()[0] == 100


@needs_mosquitto
def test_sensors_on_mqtt_next_to_one_on_modbus(tmp_path: Path) -> None:
    """The roof's 3.44 m3 are 5 cm on 68.8 m2; 36 mm/h are 1e-5 m/s, counted tick by tick."""
    file, (port,) = tmp_path / "sensors.yaml", free_ports(1)
    modbus = (CONFIG / "sensors.yaml").read_text().partition("\nroof:")[0]
    mqtt = "roof:" + (CONFIG / "sensors_mqtt.yaml").read_text().partition("\nroof:")[2]
    with mosquitto(tmp_path) as broker, ExitStack() as stack:
        file.write_text(f"{modbus}\n{mqtt}".replace(":5030", f":{port}").replace(
            "mqtt://127.0.0.1:1883", broker.address).replace("max_age: 60.0", "max_age: 10.0"))
        site = stack.enter_context(Simulator(
            "site_simulator", "--sensors", str(file), "--workbench", "0", "--cistern", "50",
            "--roof", "3.44", "--rain", "36", "--constant-evapotranspiration", "0",
        ))
        sensors, readers = read_sensors(file), {}
        for section in ("roof", "rain_gauge", "thermometer"):
            sensor = sensors.by_section[section]
            assert isinstance(sensor, MqttSensor)
            readers[section] = stack.enter_context(closing(MqttReader(section, sensor, "m")))
            readers[section].start()
        assert isinstance(sensors.cistern, ModbusSensor)
        assert read_once(sensors.cistern) == pytest.approx(2.0, abs=1e-3)
        until(lambda: all(reader.snapshot.value for reader in readers.values()), 20)
        assert readers["roof"].snapshot.value == pytest.approx(0.05, abs=5e-4)
        assert readers["rain_gauge"].snapshot.value == pytest.approx(1e-5, rel=0.6)
        assert readers["thermometer"].snapshot.value == 15.0
        site.inject("roof_silent")
        until(lambda: "has sent nothing for 5 s" in readers["roof"].snapshot.problem, 20)
        site.inject("roof_absurd", 1234)  # mm from the sensor down, which is 0.6 m up
        until(lambda: "reports -0.634 m" in readers["roof"].snapshot.problem, 20)
        site.inject("none")
        until(lambda: readers["roof"].snapshot.value, 20)


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
    with closing(DriveExchange(endpoint, 0.1)) as exchange:
        exchange.start()
        until(lambda: exchange.request_speed(1.0) or read_once(sensor) < before - 0.002, 30)
    site.process.send_signal(signal.SIGINT)
    assert site.process.wait(30) == 0, site.stderr()
