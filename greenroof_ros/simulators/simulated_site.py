"""The two tanks behind Modbus level sensors, in real time or faster."""

from __future__ import annotations

import asyncio
import functools
import random
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TextIO

from pymodbus.constants import ExcCodes

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.drives.address import Address, parse_address
from greenroof_ros.drives.modbus_line import DriveError, encode
from greenroof_ros.drives.sensor_file import TANKS, Sensor, Sensors
from greenroof_ros.model.plant import Plant
from greenroof_ros.model.pump_speed import flow_at
from greenroof_ros.model.site import Site
from greenroof_ros.simulators import faults
from greenroof_ros.simulators.faults import SITE_FAULTS
from greenroof_ros.simulators.faulty_server import FaultyServer, Wire, make_device, make_workbench
from greenroof_ros.simulators.workbench import Workbench

# How often the drive's speed is looked at within a tick, as far as there is time for it.
_LOOKS = 20
_LEAST_PAUSE_S = 0.02
_PER_MINUTE = 60.0
COLUMNS = (
    "time_s", "cistern_level_m", "roof_level_m", "speed", "pump_flow_m3_per_s", "pumped_m3",
    "precipitation_m_per_s", "evapotranspiration_m3_per_s", "fault",
)


class Weather(NamedTuple):
    """What falls and rises, tick by tick; after its last tick it stays as it is."""

    precipitation: Sequence[float]
    """m/s"""
    evapotranspiration: Sequence[float]
    """off the whole bed (m3/s)"""


class SimulatedSite:
    """Two tanks with their sensors; time is counted in ticks.

    Attributes:
        plant: the tanks.
        tick: how many have passed.
        pumped: what has left the cistern through the pump (m3).
        fault: name of the fault that stands.
    """

    def __init__(self, site: Site, weather: Weather, volumes: tuple[float, float]) -> None:
        """Begin at tick 0.

        Args:
            site: its parameters.
            weather: of its ticks.
            volumes: in cistern and roof at the beginning (m3).
        """
        self._site, self._weather = site, weather
        self.plant = Plant(site, *volumes)
        self.tick = 0
        self.pumped = 0.0
        self.fault = faults.NONE
        self._parameter = 0
        self._since = 0
        self._frozen: dict[str, list[int]] = {}
        self._random = random.Random(0)  # noqa: S311 - noise, not a secret

    def inject(self, name: str, parameter: int) -> None:
        """Let a fault stand instead of the present one.

        Args:
            name: of one of `faults.SITE_FAULTS`.
            parameter: of it; `faults.DEFAULT` for its default.
        """
        known = SITE_FAULTS[name]
        self.fault, self._since = name, self.tick
        self._parameter = known.default if parameter == faults.DEFAULT else parameter
        self._frozen.clear()

    def flow(self, speed: float) -> float:
        """Return what the pump takes from the cistern at a speed (m3/s); nothing when it is dry."""
        level = self.plant.levels()[0]
        if level < self._site.suction_level or self.fault == "closed_valve":
            return 0.0
        return flow_at(self._site, speed, level)

    def weather(self) -> tuple[float, float]:
        """Return rain (m/s) and evapotranspiration (m3/s) of the present tick."""
        rain, evapotranspiration = self._weather
        return (
            rain[min(self.tick, len(rain) - 1)],
            evapotranspiration[min(self.tick, len(evapotranspiration) - 1)],
        )

    def step(self, flow: float) -> float:
        """Move on by one tick.

        Args:
            flow: out of the cistern through the pump, the mean of the tick (m3/s).

        Returns:
            What there was of it (m3/s).
        """
        rain, evapotranspiration = self.weather()
        flows = self.plant.flows(rain, evapotranspiration, flow)
        self.plant.step(rain, flows)
        tau = self._site.tau
        if self.fault == "burst_pipe":
            self.plant.x2 = max(0.0, self.plant.x2 - tau * flows.pump)
        elif self.fault == "leak":
            self.plant.x1 = max(0.0, self.plant.x1 - tau * self._parameter * 1e-6)
        self.pumped += tau * flows.pump
        self.tick += 1
        return flows.pump

    def reading(self, tank: str, sensor: Sensor) -> list[int]:
        """Return the registers of a sensor.

        Args:
            tank: ``cistern`` or ``roof``.
            sensor: of it.
        """
        level = self.plant.levels()[TANKS.index(tank)]
        asked = self.fault.removeprefix(f"{tank}_")
        if asked == "frozen" and tank in self._frozen:
            return self._frozen[tank]
        if asked == "noisy":
            level += self._random.gauss(0.0, self._parameter * faults.LEVEL_UNIT)
        elif asked == "drifting":
            minutes = (self.tick - self._since) * self._site.tau / _PER_MINUTE
            level += minutes * self._parameter * faults.LEVEL_UNIT
        words = encode((level - sensor.offset) / sensor.scale, sensor.type, sensor.word_order)
        if asked == "absurd":
            words = [self._parameter] * len(words)
        self._frozen[tank] = words
        return words


class SiteBench:
    """Runs a simulated site on its sensors' ports and lines."""

    def __init__(
        self,
        site: SimulatedSite,
        tau: float,
        sensors: Sensors,
        workbench_address: Address,
        drive: Workbench | None,
        factor: float,
        output: TextIO | None,
        say: Callable[[str], None],
    ) -> None:
        """Prepare it; nothing is opened yet.

        Args:
            site: the site.
            tau: duration of a tick (s of simulated time).
            sensors: where they are and what they speak.
            workbench_address: TCP port of the workbench; port 0 takes a free one.
            drive: workbench of the drive that turns the pump; None for a pump that never runs.
            factor: simulated per real time.
            output: where a line of CSV goes for each tick.
            say: is told what happens, for people.

        Raises:
            ConfigurationError: both sensors answer to the same register.
        """
        self.site = site
        self._sensors: dict[str, Sensor] = {tank: getattr(sensors, tank) for tank in TANKS}
        self._drive, self._output, self._say = drive, output, say
        self._tau, self._tick_s = tau, tau / factor
        self._drive_gone = False
        self._asked = faults.DEFAULT
        addresses = dict.fromkeys(sensor.address for sensor in self._sensors.values())
        self._servers = [self._make_server(address) for address in addresses]
        self._workbench = make_workbench(workbench_address, self._read_workbench, self._put)

    @property
    def workbench_address(self) -> Address:
        """Where the workbench is; its port is known when it has started."""
        return self._workbench.address

    def _make_server(self, address: str) -> FaultyServer:
        """Return the server of a port or line, of the sensors that are on it."""
        here = {tank: each for tank, each in self._sensors.items() if each.address == address}
        # Of each device and register the tank, and which of the words of its level.
        places = {
            (sensor.device_id, sensor.register + offset): (tank, offset)
            for tank, sensor in here.items() for offset in range(sensor.registers)
        }
        if len(places) < sum(sensor.registers for sensor in here.values()):
            raise ConfigurationError(
                "both sensors answer to the same register: this cannot be simulated, input and "
                "holding registers are one here",
                key="register", value=max(sensor.register for sensor in here.values()),
            )

        def silent(device: int, register: int) -> bool:
            place = places.get((device, register))
            return place is not None and self.site.fault == f"{place[0]}_silent"

        def read(device: int) -> dict[int, int]:
            words = {tank: self.site.reading(tank, sensor) for tank, sensor in here.items()}
            return {
                register: words[tank][offset]
                for (number, register), (tank, offset) in places.items() if number == device
            }

        devices = [
            make_device(
                device, {register: False for number, register in places if number == device},
                functools.partial(read, device), lambda address, values: ExcCodes.ILLEGAL_ADDRESS,
            )
            for device in {number for number, _ in places}
        ]
        line = next(iter(here.values())).serial
        return FaultyServer(parse_address(address), line, devices, Wire(ignores=silent))

    def inject(self, name: str, parameter: int) -> None:
        """Let a fault stand instead of the present one; see `SimulatedSite.inject`."""
        self.site.inject(name, parameter)
        self._say(f"fault {name}: {SITE_FAULTS[name].meaning}")

    def _read_workbench(self) -> list[int]:
        return [0, SITE_FAULTS[self.site.fault].number, self._asked]

    def _put(self, register: int, value: int) -> bool:
        """Do what a register of the workbench stands for; tell whether it can."""
        if register == faults.PARAMETER:
            self._asked = value
            return True
        name = faults.name_of(value, SITE_FAULTS)
        if name:
            self.inject(name, self._asked)
        return name != ""

    async def start(self) -> None:
        """Open all ports.

        Raises:
            ConfigurationError: one of them cannot be opened.
        """
        for server in (*self._servers, self._workbench):
            await server.open()

    async def run(self, ended: asyncio.Event) -> None:
        """Let time pass until the end; after a pause of this process, catch up."""
        began = time.monotonic()
        if self._output is not None:
            print(*COLUMNS, sep=",", file=self._output, flush=True)
        speed = await self._speed()
        while not ended.is_set():
            due = began + (self.site.tick + 1) * self._tick_s
            flow, speed = await self._mean_flow(speed, due)
            self._write_line(speed, self.site.step(flow))
        for server in (*self._servers, self._workbench):
            server.close()
        if self._drive is not None:
            self._drive.close()

    async def _mean_flow(self, speed: float, due: float) -> tuple[float, float]:
        """Look at the drive until a tick is over; return its mean flow (m3/s) and the last speed.

        Args:
            speed: at the beginning of the tick (share of rated).
            due: when it is over.
        """
        pause = max(self._tick_s / _LOOKS, _LEAST_PAUSE_S)
        pumped = passed = 0.0
        flow = self.site.flow(speed)
        at = time.monotonic()
        while True:
            await asyncio.sleep(max(0.0, min(pause, due - at)))
            speed = await self._speed()
            before, at, former, flow = at, time.monotonic(), flow, self.site.flow(speed)
            pumped += (at - before) * (former + flow) / 2
            passed += at - before
            if at >= due:
                return (pumped / passed if passed else flow), speed

    async def _speed(self) -> float:
        """Return the true speed of the drive (share of rated); 0 if it is gone."""
        return await asyncio.to_thread(self._ask) if self._drive is not None else 0.0

    def _ask(self) -> float:
        """Ask the drive for its speed, and tell it how deep the water is."""
        assert self._drive is not None
        try:
            speed = self._drive.speed()
            self._drive.set_cistern_level(self.site.plant.levels()[0])
        except DriveError as error:
            if not self._drive_gone:
                self._say(f"{error}: the pump counts as standing")
            self._drive_gone = True
            return 0.0
        if self._drive_gone:
            self._say("the drive's workbench answers again")
        self._drive_gone = False
        return speed

    def _write_line(self, speed: float, flow: float) -> None:
        if self._output is None:
            return
        site = self.site
        cistern, roof = site.plant.levels()
        rain, evapotranspiration = site.weather()
        print(
            f"{(site.tick * self._tau):.10g},{cistern:.9g},{roof:.9g},{speed:.4f},{flow:.9g},"
            f"{site.pumped:.9g},{rain:.9g},{evapotranspiration:.9g},{site.fault}",
            file=self._output, flush=True,
        )
