"""Real-time simulation of a cistern and a roof with sensors on Modbus and MQTT."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.mqtt import make_client
from greenroof_ros.live.devices.json_path import parse_path
from greenroof_ros.live.devices.modbus_line import encode, parse_address
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, Sensors
from greenroof_ros.live.simulators.server import Device, Server
from greenroof_ros.physics.pump import flow_at
from greenroof_ros.physics.sensor_and_pump import SensorAndPump
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.site.site import Site

# Number of readings of the drive's speed per tick, if there is time for as many.
_POLLS = 20
_MIN_PAUSE_S = 0.02
_TEMPERATURE = 15.0
# Number of messages within the longest silence that the sensor file allows.
_MESSAGES = 5


class SimulatedSite:
    """Simulation of a cistern and a roof in ticks, with the sensors that measure them.

    Attributes:
        virtual_site: cistern and roof.
        servers: Modbus servers of the sensors.
        pumped: volume pumped out of the cistern so far (m3).
    """

    def __init__(
        self,
        site: Site,
        precipitation: Sequence[float],
        evapotranspiration: Sequence[float],
        volumes: tuple[float, float],
        sensors: Sensors,
        speed: Callable[[], float],
    ) -> None:
        """Prepare the sensors without opening ports, lines or connections.

        Args:
            site: parameters of the site.
            precipitation: rain rate in each tick (m/s); the last value applies to all later ticks.
            evapotranspiration: loss from the whole bed in each tick (m3/s); the last value applies
                to all later ticks.
            volumes: initial volumes of water in the cistern and on the roof (m3).
            sensors: the sensors, with addresses and protocols; a thermometer always reads 15 degC.
            speed: function that returns the current speed of the pump (share of the rated speed).

        Raises:
            ConfigurationError: if two sensors use the same register, the MQTT library is not
                installed, or a login file is invalid.
        """
        self._site, self._speed = site, speed
        self._weather = precipitation, evapotranspiration
        self.virtual_site = VirtualSite(site, *volumes, 0, SensorAndPump())
        self.pumped, self._rained, self._flowing = 0.0, 0.0, 0.0
        self._sensors = sensors.by_section
        self.servers: list[Server] = []
        lines: dict[str, dict[int, dict[str, ModbusSensor]]] = {}
        self._publishers = []
        for section, sensor in self._sensors.items():
            if isinstance(sensor, ModbusSensor):
                devices = lines.setdefault(sensor.address, {})
                devices.setdefault(sensor.device_id, {})[section] = sensor
            else:
                self._publishers.append(
                    SimulatedMqttSensor(section, sensor, partial(self.published, section))
                )
        for address, by_id in lines.items():
            line = next(iter(next(iter(by_id.values())).values())).serial
            self.servers.append(Server(
                parse_address(address),
                {device_id: self.device(sensors) for device_id, sensors in by_id.items()}, line,
            ))

    @property
    def tick(self) -> int:
        """The number of ticks simulated so far."""
        return self.virtual_site.tick

    def device(self, sensors: Mapping[str, ModbusSensor]) -> Device:
        """Return the Modbus device that serves these sensors."""

        def read() -> dict[int, int]:
            return {
                sensor.register + offset: word for section, sensor in sensors.items()
                for offset, word in enumerate(self.words(section, sensor))
            }

        if len(read()) < sum(sensor.registers for sensor in sensors.values()):
            raise ConfigurationError(
                "is used by two sensors, which cannot be simulated: the simulator does not "
                "distinguish input registers from holding registers",
                key="register", value=max(sensor.register for sensor in sensors.values()),
            )
        return Device(read)

    @property
    def addresses(self) -> str:
        """The addresses of the sensors, as text."""
        return ", ".join(f"{name} sensor {sensor}" for name, sensor in self._sensors.items())

    def words(self, section: str, sensor: ModbusSensor) -> list[int]:
        """Return the current values of a sensor's registers."""
        return encode(self.raw(section), sensor.type, sensor.word_order)

    def raw(self, section: str) -> float:
        """Return the current raw value of a sensor."""
        return self._sensors[section].raw_for(self.true(section))

    def true(self, section: str) -> float:
        """Return the true current value of the quantity that a sensor measures."""
        sensor = self._sensors[section]
        cistern, roof = self.virtual_site.levels()
        return {
            "cistern": cistern, "roof": roof, "thermometer": _TEMPERATURE,
            "flow_meter": self.pumped if sensor.counts else self._flowing,
            "rain_gauge": self._rained if sensor.counts else self._present_weather()[0],
        }[section]

    def published(self, section: str) -> float | None:
        """Return the raw value that a sensor publishes on MQTT; None for a silent sensor."""
        return self.raw(section)

    async def run(self, ended: asyncio.Event) -> None:
        """Run the site until the simulator stops; after a pause of this process, catch up."""
        publishing = [asyncio.create_task(publisher.run(ended)) for publisher in self._publishers]
        started_at = time.monotonic()
        while not ended.is_set():
            flow = await self._mean_flow(started_at + (self.tick + 1) * self._site.tau)
            self.step(self._speed(), flow)
        await asyncio.gather(*publishing)

    async def _mean_flow(self, due: float) -> float:
        """Return the mean flow (m3/s) until a tick ends (s, `time.monotonic`)."""
        pause, flows = max(self._site.tau / _POLLS, _MIN_PAUSE_S), list[float]()
        while not flows or time.monotonic() < due:
            await asyncio.sleep(max(0.0, min(pause, due - time.monotonic())))
            flows.append(self.flow(self._speed()))
        return sum(flows) / len(flows)

    def flow(self, speed: float) -> float:
        """Return the pump's flow from the cistern at a speed (m3/s); 0 if it runs dry."""
        level = self.virtual_site.levels()[0]
        return 0.0 if level < self._site.suction_level else flow_at(self._site, speed, level)

    def _present_weather(self) -> tuple[float, float]:
        """Return rain (m/s) and evapotranspiration (m3/s) in the current tick."""
        rain, evapotranspiration = (
            series[min(self.tick, len(series) - 1)] for series in self._weather
        )
        return rain, evapotranspiration

    def step(self, speed: float, flow: float) -> None:
        """Advance by one tick.

        Args:
            speed: speed of the drive at the end of the tick (share of the rated speed).
            flow: mean flow out of the cistern through the pump in the tick (m3/s).
        """
        rain, evapotranspiration = self._present_weather()
        tau = self._site.tau
        flows = self.virtual_site.act(rain, evapotranspiration, 0.0, pumped=flow)
        self.virtual_site.step()
        self.pumped += tau * flows.pump
        self._rained += tau * rain
        self._flowing = flows.pump


def payload(raw: float, sensor: MqttSensor) -> str:
    """Return an MQTT message that contains a raw value at the sensor's path."""
    content: Any = raw
    for step in reversed(parse_path(sensor.value)):
        content = {step: content} if isinstance(step, str) else [None] * step + [content]
    return json.dumps(content)


class SimulatedMqttSensor:
    """A simulated sensor that publishes its readings at regular intervals."""

    def __init__(self, name: str, sensor: MqttSensor, read: Callable[[], float | None]) -> None:
        """Prepare the sensor without connecting.

        Args:
            name: name of the sensor.
            sensor: the sensor's section of the sensor file.
            read: function that returns the raw value, or None if nothing is to be published.
        """
        self._sensor, self._read = sensor, read
        broker, self._topic = sensor.broker_and_topic()
        self._client = make_client(
            broker, f"simulated_{name}", lambda: None, lambda topic, payload, retained: None,
        )

    async def run(self, ended: asyncio.Event) -> None:
        """Publish readings until the simulator stops."""
        self._client.loop_start()
        while not ended.is_set():
            raw = self._read()
            if raw is not None:
                self._client.publish(self._topic, payload(raw, self._sensor))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(ended.wait(), self._sensor.max_age / _MESSAGES)
        self._client.disconnect()
