"""Real-time simulation of a cistern and a roof with sensors on Modbus and MQTT."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from greenroof_ros.base.mqtt import make_client, parse_path
from greenroof_ros.live.devices.modbus_line import encode, parse_address
from greenroof_ros.live.devices.sensor_file import ModbusSensor, MqttSensor, Sensors
from greenroof_ros.live.simulators.relay import LEAK, SimulatedValve
from greenroof_ros.live.simulators.server import Server, make_device
from greenroof_ros.physics.parameters import State
from greenroof_ros.physics.pump import SensorAndPump, flow_at
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
        valve: SimulatedValve | None = None,
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
            valve: the valve of the low outlet; None at a site without one.
        """
        self._site, self._speed, self._valve = site, speed, valve
        self._weather = precipitation, evapotranspiration
        # The simulated valve moves by itself.
        follows = replace(site, valve_moves_per_hour=None)
        self.virtual_site = VirtualSite(follows, *volumes, 0, SensorAndPump())
        self.pumped, self._rained, self._flowing, self._opening = 0.0, 0.0, 0.0, 1.0
        self._sensors = sensors.by_section
        modbus = [each for each in self._sensors.values() if isinstance(each, ModbusSensor)]
        lines = {sensor.address: sensor.serial for sensor in modbus}
        self.servers = [
            Server(
                parse_address(line),
                [make_device(number, partial(self._read, line, number)) for number in sorted(
                    {sensor.device_id for sensor in modbus if sensor.address == line})],
                serial,
            ) for line, serial in lines.items()
        ]

    @property
    def addresses(self) -> str:
        """The addresses of the sensors, as text."""
        return ", ".join(f"{name} sensor {sensor}" for name, sensor in self._sensors.items())

    # --- sensors ----------------------------------------------------------------------------------

    def _read(self, line: str, device_id: int) -> dict[int, int]:
        """Return the current values of the registers of a device."""
        return {
            sensor.register + offset: word for section, sensor in self._sensors.items()
            if isinstance(sensor, ModbusSensor)
            and (sensor.address, sensor.device_id) == (line, device_id)
            for offset, word in enumerate(self.words(section, sensor))
        }

    def words(self, section: str, sensor: ModbusSensor) -> list[int]:
        """Return the current values of a sensor's registers."""
        return encode(self.raw(section) or 0.0, sensor.type, sensor.word_order)

    def raw(self, section: str) -> float | None:
        """Return the current raw value of a sensor; None for a sensor that is silent."""
        sensor = self._sensors[section]
        return (self.true(section) - sensor.offset) / sensor.scale

    def true(self, section: str) -> float:
        """Return the true current value of the quantity that a sensor measures."""
        counts = self._sensors[section].counts
        cistern, roof = self.virtual_site.levels()
        switches = {} if self._valve is None else self._valve.switches()
        values = switches | {
            "cistern": cistern, "roof": roof, "thermometer": _TEMPERATURE,
            "flow_meter": self.pumped if counts else self._flowing,
            "rain_gauge": self._rained if counts else self._present_weather()[0],
        }
        return values.get(section, 0.0)  # a site without a valve has no switches

    async def publish(self, section: str, sensor: MqttSensor, ended: asyncio.Event) -> None:
        """Publish the readings of a sensor at regular intervals until the simulator stops.

        Raises:
            ConfigurationError: if the MQTT library is not installed, or a login file is invalid.
        """
        broker, topic = sensor.place
        client = make_client(broker, f"simulated_{section}", lambda: None, lambda *message: None)
        client.loop_start()
        while not ended.is_set():
            if (raw := self.raw(section)) is not None:
                content: Any = raw
                for step in reversed(parse_path(sensor.value)):
                    content = {step: content} if isinstance(step, str) else [content] * (step + 1)
                client.publish(topic, json.dumps(content))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(ended.wait(), sensor.max_age / _MESSAGES)
        client.disconnect()

    # --- water ------------------------------------------------------------------------------------

    async def run(self, ended: asyncio.Event) -> None:
        """Run the site until the simulator stops; after a pause of this process, catch up."""
        publishing = [
            asyncio.create_task(self.publish(section, sensor, ended))
            for section, sensor in self._sensors.items() if isinstance(sensor, MqttSensor)
        ]
        started_at = time.monotonic()
        while not ended.is_set():
            due = started_at + (self.virtual_site.tick + 1) * self._site.tau
            flow = await self._mean_flow(due, ended)
            self.step(flow)
        await asyncio.gather(*publishing)

    async def _mean_flow(self, due: float, ended: asyncio.Event) -> float:
        """Return the pump's mean flow (m3/s) until a time (s, `time.monotonic`) or the end."""
        pause, samples = max(self._site.tau / _POLLS, _MIN_PAUSE_S), list[tuple[float, float]]()
        while not samples or (time.monotonic() < due and not ended.is_set()):
            await asyncio.sleep(max(0.0, min(pause, due - time.monotonic())))
            opening = 1.0 if self._valve is None else self._valve.advance()
            samples.append((self.flow(self._speed()), opening))
        self._opening = sum(opening for _, opening in samples) / len(samples)
        return sum(flow for flow, _ in samples) / len(samples)

    def flow(self, speed: float) -> float:
        """Return the pump's flow from the cistern at a speed (m3/s); 0 if it runs dry."""
        level = self.virtual_site.levels()[0]
        return 0.0 if level < self._site.suction_level else flow_at(self._site, speed, level)

    def _present_weather(self) -> tuple[float, float]:
        """Return rain (m/s) and evapotranspiration (m3/s) in the current tick."""
        rain, evapotranspiration = (
            series[min(self.virtual_site.tick, len(series) - 1)] for series in self._weather
        )
        return rain, evapotranspiration

    def step(self, flow: float) -> None:
        """Advance by one tick with a mean flow of the pump out of the cistern (m3/s)."""
        rain, evapotranspiration = self._present_weather()
        flows = self.virtual_site.act(
            rain, evapotranspiration, 0.0, pumped=flow, outlet=self._opening
        )
        self.virtual_site.step()
        if self._valve is not None and self._valve.fault == "leak":
            x1, x2, layer = self.virtual_site.state
            kept = self._site.cistern_volume(self._site.min_outlet_level)
            x1 = max(min(x1, kept), x1 - self._site.tau * LEAK)
            self.virtual_site.state = State(x1, x2, layer)
        self.pumped += self._site.tau * flows.pump
        self._rained += self._site.tau * rain
        self._flowing = flows.pump
