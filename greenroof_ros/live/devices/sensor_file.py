"""Description of a site's sensors: ``config/sensors.yaml``, as frozen dataclasses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.files import shared_directory
from greenroof_ros.base.mqtt import Broker, parse_topic
from greenroof_ros.base.parameter import entry, read_record
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.devices.modbus_line import (
    WIDTHS,
    WORD_ORDERS,
    Address,
    Serial,
    coding_mistakes,
    parse_address,
)

TANKS = ("cistern", "roof")
_MAX_FILTER_S = 30.0
# A flow that is shown for 12 s while the pump is stopped is a fault.
_MAX_AFTERFLOW_S = 10.0
# A level further below 0 (m) is not noise: a tank would seem empty.
_LEVEL_NOISE = 0.1


# The keys that together say where a value is, which no two sensors may have in common.
_PLACE = ("address", "device_id", "kind", "register", "value")
# The topic of the quantity that a sensor measures, by section of the file.
QUANTITIES = {
    section: read_topics()[name] for section, name in {
        "cistern": "/cistern/level", "roof": "/roof/level", "flow_meter": "/pump/meter",
        "rain_gauge": "/gauge/precipitation", "thermometer": "/gauge/temperature",
        "open_switch": "/outlet/open_switch", "closed_switch": "/outlet/closed_switch",
    }.items()
}


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Keys that all sensors have in common. The value is the median of the converted readings."""

    scale: float = entry(
        "factor: value = scale x raw + offset, in the unit of the quantity", -1e3, 1e3
    )
    low: float = entry(
        "minimum accepted value; below 0 it allows for noise, and negative values then count as 0, "
        "except for temperatures", -100, 100,
    )
    high: float = entry("maximum accepted value", -100, 100)
    offset: float = entry(
        "value at a raw reading of 0", -1e3, 1e3, default=0.0)
    median: int = entry(
        "number of readings in the median filter; 1 for no filter", 1, 99, default=5
    )
    counts: bool = entry(
        "if true, scale x raw is a running total (m or m3), and the value its increase per second",
        default=False,
    )


@dataclass(frozen=True, kw_only=True)
class ModbusSensor(Sensor):
    """A sensor that is read over Modbus."""

    address: str = entry(
        "address of the sensor: tcp://HOST:PORT, or a serial device such as /dev/ttyUSB0"
    )
    device_id: int = entry("unit identifier or slave address of the sensor", 0, 255)
    register: int = entry(
        "address on the wire, counted from 0", 0, 65535
    )
    kind: str = entry(
        "register type: input (function 4) or holding (function 3)", choices=("input", "holding")
    )
    type: str = entry("encoding of the value", choices=tuple(WIDTHS))
    word_order: str = entry(
        "word order of a value of more than one register",
        choices=WORD_ORDERS, default="",
    )
    missing: int | None = entry("raw value that means 'no reading'", default=None)
    period: float = entry(
        "time between two readings (s); at most half of the maximum age of the quantity", 0.05,
        3600, default=1.0,
    )
    baud_rate: int = entry(
        "baud rate of the serial line", 1200, 1_000_000, default=19200
    )
    parity: str = entry(
        "parity of the serial line", choices=("even", "odd", "none"), default="even"
    )
    stop_bits: int = entry("number of stop bits on the serial line", 1, 2, default=1)

    def __str__(self) -> str:
        return f"{self.address}, device {self.device_id}"

    @property
    def place(self) -> Address:
        """The serial line or TCP port, which several sensors may share."""
        return parse_address(self.address)

    @property
    def serial(self) -> Serial:
        """The settings of a serial line."""
        return Serial(self.baud_rate, self.parity, self.stop_bits, self.device_id)


@dataclass(frozen=True, kw_only=True)
class MqttSensor(Sensor):
    """A sensor that publishes to an MQTT broker."""

    address: str = entry("broker and topic: mqtt://HOST[:PORT]/TOPIC, or mqtts:// for TLS")
    value: str = entry(
        "path of the number in a JSON message, such as ANALOG.Range1 or sensors[0].distance",
        default="",
    )
    max_age: float = entry(
        "maximum silence of the sensor (s)",
        0.1, 3600,
    )
    login: str = entry(
        "file with username and password, which others must not be able to read (chmod 600)",
        default="",
    )
    authority: str = entry(
        "file of trusted certificates (PEM) in place of the system's",
        default="",
    )

    def __str__(self) -> str:
        return self.address

    @staticmethod
    def fits(section: Mapping[str, Any]) -> bool:
        """Return whether a section of the file contains the address of an MQTT sensor."""
        return str(section.get("address")).startswith(("mqtt://", "mqtts://"))

    @property
    def place(self) -> tuple[Broker, str]:
        """The broker and the topic."""
        return parse_topic(self.address, "address", self.login, self.authority)


@dataclass(frozen=True)
class Sensors:
    """The sensors of a site."""

    cistern: ModbusSensor | MqttSensor = entry("level sensor of the cistern (m)")
    roof: ModbusSensor | MqttSensor | None = entry(
        "level sensor of the roof (m), needed for a pump", default=None
    )
    flow_meter: ModbusSensor | MqttSensor | None = entry(
        "flow meter of the pump (m3/s)", default=None
    )
    rain_gauge: ModbusSensor | MqttSensor | None = entry(
        "rain gauge (m/s)", default=None
    )
    thermometer: ModbusSensor | MqttSensor | None = entry(
        "thermometer for the air temperature (degC)", default=None
    )
    open_switch: ModbusSensor | MqttSensor | None = entry(
        "1 while the outlet valve is fully open, otherwise 0", default=None
    )
    closed_switch: ModbusSensor | MqttSensor | None = entry(
        "1 while the outlet valve is closed, otherwise 0", default=None
    )

    @property
    def by_section(self) -> dict[str, ModbusSensor | MqttSensor]:
        """The site's sensors, keyed by section of the file."""
        return {name: sensor for name in QUANTITIES if (sensor := getattr(self, name)) is not None}


def default_sensors() -> Path:
    """Return the sensor file that is shipped with the package."""
    return shared_directory() / "config" / "sensors.yaml"


def read_sensors(path: Path, max_ages: Mapping[str, float] | None = None) -> Sensors:
    """Read and check a sensor file.

    Args:
        path: the file.
        max_ages: maximum ages of the quantities (s), where known, keyed by parameter name.
            Neither ``max_age`` nor twice the ``period`` of a sensor may exceed the maximum age.

    Raises:
        ConfigurationError: if a key or value is missing, unknown, impossible or contradictory.
    """
    return read_record(Sensors, path, lambda sensors, _: _mistakes(sensors, max_ages or {}))


def _mistakes(sensors: Sensors, max_ages: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    """Yield the key and a description of every mistake; later checks rely on earlier ones."""
    for section, sensor in sensors.by_section.items():
        for key, expected in _sensor_mistakes(sensor, section, max_ages):
            yield f"{section}.{key}", expected
    for (first, earlier), (second, later) in combinations(sensors.by_section.items(), 2):
        if all(getattr(earlier, key, 0) == getattr(later, key, 0) for key in _PLACE):
            key = "register" if isinstance(later, ModbusSensor) else "address"
            yield f"{second}.{key}", f"must differ from that of the {first.replace('_', ' ')}"


def _sensor_mistakes(
    sensor: ModbusSensor | MqttSensor, section: str, max_ages: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    try:
        _ = sensor.place
    except ConfigurationError as error:
        yield "address", error.expected
    topic = QUANTITIES[section]
    limit = topic.max_age.parameter if topic.max_age is not None else ""
    max_age = max_ages.get(limit, math.inf)
    lowest = topic.low - _LEVEL_NOISE if section in TANKS else -math.inf
    if isinstance(sensor, MqttSensor):
        key, interval, longest = "max_age", sensor.max_age, max_age
    else:
        yield from coding_mistakes(sensor.type, sensor.word_order)
        key, interval, longest = "period", sensor.period, max_age / 2
    late = 0.0 if sensor.counts else sensor.median // 2 * interval
    longest_late = _MAX_AFTERFLOW_S - interval if section == "flow_meter" else _MAX_FILTER_S
    for is_wrong, name, expected in (
        (sensor.low < lowest, "low", f"must be at least {lowest:g} {topic.unit}, since noise of "
         "the sensor cannot account for a lower level"),
        (sensor.counts and section not in ("flow_meter", "rain_gauge"), "counts",
         "is only allowed for a flow meter or a rain gauge"),
        (late > longest_late, "median", f"must be smaller: it delays the value by {late:g} s, but "
         f"the delay may be at most {longest_late:g} s"),
        (interval > longest, key, f"must be at most {longest:g} s, since older values than "
         f"{limit} ({max_age:g} s) are not used"),
    ):
        if is_wrong:
            yield name, expected
