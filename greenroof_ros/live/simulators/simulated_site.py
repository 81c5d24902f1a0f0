"""The two tanks behind sensors on Modbus and MQTT, in real time or faster."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TextIO

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.mqtt import make_client
from greenroof_ros.live.devices.modbus_line import (
    Address,
    DriveError,
    ModbusLine,
    encode,
    parse_address,
)
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, Sensors
from greenroof_ros.live.simulators import faults
from greenroof_ros.live.simulators.server import Bench, Device, Server
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site

# Readings of the drive's speed per tick, if there is time for as many.
_POLLS = 20
_MIN_PAUSE_S = 0.02
_DRIVE_ANSWERS_S = 1.0
_PER_MINUTE = 60.0
_TEMPERATURE = 15.0
# Number of messages within the longest silence that the sensor file allows.
_MESSAGES = 5
COLUMNS = (
    "time_s", "cistern_level_m", "roof_level_m", "speed", "pump_flow_m3_per_s", "pumped_m3",
    "precipitation_m_per_s", "evapotranspiration_m3_per_s", "fault",
)


class SiteBench(Bench):
    """Runs cistern and roof behind their sensors' ports, lines and topics, tick by tick.

    Attributes:
        plant: cistern and roof.
        tick: number of ticks so far.
        pumped: volume pumped out of the cistern so far (m3).
        rained: rain so far (m).
    """

    def __init__(
        self,
        site: Site,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
        volumes: tuple[float, float],
        sensors: Sensors,
        workbench: Address,
        drive: Address | None,
        factor: float,
        output: TextIO | None,
    ) -> None:
        """Prepare the bench without opening anything.

        Args:
            site: its parameters.
            precipitation: of each tick (m/s); the last value then continues.
            evapotranspiration: of each tick, from the whole bed (m3/s); the last value continues.
            volumes: in cistern and roof at the beginning (m3).
            sensors: their addresses and protocols; a thermometer reads 15 degC.
            workbench: TCP port of the workbench; port 0 takes a free one.
            drive: workbench of the drive that turns the pump; None for a pump that never runs.
            factor: simulated time per real time.
            output: for a CSV line per tick; None for none.

        Raises:
            ConfigurationError: two sensors have the same register, the MQTT library is missing, or
                a file for the login is wrong.
        """
        super().__init__(faults.SITE_FAULTS, workbench)
        self._site = site
        self._weather = precipitation, evapotranspiration
        self.plant = Plant(site, *volumes)
        self.tick, self.pumped, self.rained, self._flowing = 0, 0.0, 0.0, 0.0
        self._sensors = sensors.by_section
        self._drive = None if drive is None else ModbusLine(
            drive, port=0, device_id=faults.DEVICE_ID, timeout_s=_DRIVE_ANSWERS_S
        )
        self._drive_lost, self._output = False, output
        self._tick_s = site.tau / factor
        self._fault_since = 0
        self._frozen: dict[str, float] = {}
        self._random = random.Random(0)  # noqa: S311 - noise, not a secret
        lines: dict[str, dict[int, dict[str, ModbusSensor]]] = {}
        self._publishers = []
        for section, sensor in self._sensors.items():
            if isinstance(sensor, ModbusSensor):
                devices = lines.setdefault(sensor.address, {})
                devices.setdefault(sensor.device_id, {})[section] = sensor
            else:
                self._publishers.append(
                    SimulatedMqttSensor(section, sensor, partial(self._published, section))
                )
        for address, by_id in lines.items():
            line = next(iter(next(iter(by_id.values())).values())).serial
            self.servers.append(Server(
                parse_address(address),
                {device_id: self._device(sensors) for device_id, sensors in by_id.items()}, line,
            ))

    def _device(self, sensors: Mapping[str, ModbusSensor]) -> Device:
        """Return the Modbus device that has these sensors."""
        ranges = {
            section: range(sensor.register, sensor.register + sensor.registers)
            for section, sensor in sensors.items()
        }

        def words(section: str, sensor: ModbusSensor) -> list[int]:
            if self._has_fault(section, "absurd"):
                return [self.fault.parameter] * sensor.registers
            return encode(self._raw(section), sensor.type, sensor.word_order)

        def read() -> dict[int, int]:
            return {
                register: word for section, sensor in sensors.items()
                for register, word in zip(ranges[section], words(section, sensor), strict=True)
            }

        def on_request(register: int) -> bool:
            return not any(
                self._has_fault(section, "silent") and register in registers
                for section, registers in ranges.items()
            )

        if len(read()) < sum(map(len, ranges.values())):
            raise ConfigurationError(
                "two sensors answer to the same register: this cannot be simulated, since input "
                "and holding registers are the same here",
                key="register", value=max(registers[0] for registers in ranges.values()),
            )
        return Device(read, on_request=on_request)

    @property
    def addresses(self) -> str:
        """The addresses of the sensors."""
        return ", ".join(f"{name} sensor {sensor}" for name, sensor in self._sensors.items())

    def inject(self, name: str, parameter: int) -> bool:
        """Replace the present fault."""
        self._fault_since = self.tick
        self._frozen.clear()
        return super().inject(name, parameter)

    def _has_fault(self, section: str, name: str) -> bool:
        return self.fault.name == f"{section}_{name}"

    def _raw(self, section: str) -> float:
        """Return the raw value of a sensor; faults other than 'absurd' and 'silent' are in it."""
        sensor, parameter = self._sensors[section], self.fault.parameter
        if self._has_fault(section, "frozen") and section in self._frozen:
            return self._frozen[section]
        cistern, roof = self.plant.levels()
        value = {
            "cistern": cistern, "roof": roof, "thermometer": _TEMPERATURE,
            "flow_meter": self.pumped if sensor.counts else self._flowing,
            "rain_gauge": self.rained if sensor.counts else self._present_weather()[0],
        }[section]
        if self._has_fault(section, "noisy"):
            value += self._random.gauss(0.0, parameter * faults.LEVEL_UNIT)
        elif self._has_fault(section, "drifting"):
            minutes = (self.tick - self._fault_since) * self._site.tau / _PER_MINUTE
            value += minutes * parameter * faults.LEVEL_UNIT
        self._frozen[section] = sensor.raw_for(value)
        return self._frozen[section]

    def _published(self, section: str) -> float | None:
        """Return the raw value that a sensor publishes on MQTT; None if it is silent."""
        if self._has_fault(section, "silent"):
            return None
        return self.fault.parameter if self._has_fault(section, "absurd") else self._raw(section)

    # --- time -------------------------------------------------------------------------------------

    async def run(self, ended: asyncio.Event) -> None:
        """Run the site until the end; after a pause of this process, catch up."""
        if self._drive is None:
            print(
                "no drive is connected: the pump never runs, no water reaches the roof; if a "
                "drive simulator runs, add --drive-at with its workbench, such as "
                "tcp://127.0.0.1:5021",
                flush=True,
            )
        if self._output is not None:
            print(*COLUMNS, sep=",", file=self._output, flush=True)
        publishing = [asyncio.create_task(publisher.run(ended)) for publisher in self._publishers]
        started_at = time.monotonic()
        speed = await self._speed()
        while not ended.is_set():
            due = started_at + (self.tick + 1) * self._tick_s
            flow, speed = await self._mean_flow(speed, due)
            self._step(speed, flow)
        await asyncio.gather(*publishing)
        if self._drive is not None:
            self._drive.close()

    async def _mean_flow(self, speed: float, due: float) -> tuple[float, float]:
        """Watch the drive until the end of a tick; return its mean flow (m3/s) and last speed.

        Args:
            speed: at the beginning of the tick (share of rated).
            due: end of the tick (s, `time.monotonic`).
        """
        pause = max(self._tick_s / _POLLS, _MIN_PAUSE_S)
        pumped = passed = 0.0
        flow = self._flow(speed)
        at = time.monotonic()
        while True:
            await asyncio.sleep(max(0.0, min(pause, due - at)))
            speed = await self._speed()
            before, at, former, flow = at, time.monotonic(), flow, self._flow(speed)
            pumped += (at - before) * (former + flow) / 2
            passed += at - before
            if at >= due:
                return (pumped / passed if passed else flow), speed

    async def _speed(self) -> float:
        """Return the true speed of the drive (share of rated); 0 if it does not answer."""
        if self._drive is None:
            return 0.0
        return await asyncio.to_thread(self._update_drive, self._drive)

    def _update_drive(self, drive: ModbusLine) -> float:
        """Read the speed from the drive's workbench, and write the cistern level to it."""
        depth = round(self.plant.levels()[0] / faults.LEVEL_UNIT)
        try:
            if not drive.connected:
                drive.connect()
            speed = drive.read(faults.SPEED, 1)[0] * faults.SPEED_UNIT
            drive.write(faults.CISTERN_LEVEL, min(max(depth, 0), 0xFFFF))
        except DriveError as error:
            drive.close()
            if not self._drive_lost:
                self.log(f"{error}: the pump is assumed to be stopped")
            self._drive_lost = True
            return 0.0
        if self._drive_lost:
            self.log("the drive's workbench answers again")
        self._drive_lost = False
        return speed

    def _flow(self, speed: float) -> float:
        """Return what the pump takes from the cistern at a speed (m3/s); 0 if dry or shut."""
        level = self.plant.levels()[0]
        if level < self._site.suction_level or self.fault.name == "closed_valve":
            return 0.0
        return flow_at(self._site, speed, level)

    def _present_weather(self) -> tuple[float, float]:
        """Return rain (m/s) and evapotranspiration (m3/s) in the present tick."""
        rain, evapotranspiration = (
            series[min(self.tick, len(series) - 1)] for series in self._weather
        )
        return rain, evapotranspiration

    def _step(self, speed: float, flow: float) -> None:
        """Advance by one tick, and write its CSV line.

        Args:
            speed: of the drive at the end of the tick (share of rated).
            flow: out of the cistern through the pump, mean of the tick (m3/s).
        """
        rain, evapotranspiration = self._present_weather()
        plant, tau = self.plant, self._site.tau
        flows = plant.flows(rain, evapotranspiration, flow)
        plant.step(rain, flows)
        if self.fault.name == "burst_pipe":
            plant.x2 = max(0.0, plant.x2 - tau * flows.pump)
        elif self.fault.name == "leak":
            plant.x1 = max(0.0, plant.x1 - tau * self.fault.parameter * 1e-6)
        self.pumped += tau * flows.pump
        self.rained += tau * rain
        self._flowing = flows.pump
        self.tick += 1
        if self._output is not None:
            cistern, roof = plant.levels()
            rain, evapotranspiration = self._present_weather()
            print(
                f"{(self.tick * tau):.10g},{cistern:.9g},{roof:.9g},{speed:.4f},{flows.pump:.9g},"
                f"{self.pumped:.9g},{rain:.9g},{evapotranspiration:.9g},{self.fault.name}",
                file=self._output, flush=True,
            )


def payload(raw: float, sensor: MqttSensor) -> str:
    """Return a message that has a number at the sensor's path."""
    content: Any = raw
    for step in reversed(sensor.steps):
        content = {step: content} if isinstance(step, str) else [None] * step + [content]
    return json.dumps(content)


class SimulatedMqttSensor:
    """Publishes readings regularly, and its availability if the sensor has a topic for that."""

    def __init__(self, name: str, sensor: MqttSensor, read: Callable[[], float | None]) -> None:
        """Prepare the sensor without connecting.

        Args:
            name: of the sensor.
            sensor: where and how it publishes.
            read: returns its raw value; None if it must not publish.
        """
        self._sensor, self._read = sensor, read
        broker, self._topic = sensor.broker_and_topic()
        self._will = (sensor.available, "offline") if sensor.available else None
        self._client = make_client(
            broker, f"simulated_{name}_{secrets.token_hex(6)}", self._announce,
            lambda topic, payload, retained: None, will=self._will,
        )

    def _announce(self) -> None:
        if self._will is not None:
            self._client.publish(self._sensor.available, self._sensor.online, qos=1, retain=True)

    async def run(self, ended: asyncio.Event) -> None:
        """Publish until the simulator ends."""
        self._client.loop_start()
        while not ended.is_set():
            raw = self._read()
            if raw is not None:
                self._client.publish(self._topic, payload(raw, self._sensor))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(ended.wait(), self._sensor.max_age / _MESSAGES)
        if self._will is not None:
            self._client.publish(*self._will, qos=1, retain=True)
        self._client.disconnect()
