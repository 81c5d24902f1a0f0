"""The sensors of a site: ``config/sensors.yaml``, as frozen dataclasses."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.interface import Topic, read_topics
from greenroof_ros.common.mqtt import Broker, parse_topic
from greenroof_ros.common.parameter import Word, entry, read_record
from greenroof_ros.live.devices.modbus_line import (
    WIDTHS,
    WORD_ORDERS,
    ModbusLine,
    Serial,
    coding_mistakes,
    limits,
    parse_address,
)

TANKS = ("cistern", "roof")
_MAX_FILTER_S = 30.0
# A flow that is shown for 12 s (follow_time) while the pump is stopped is a fault.
_MAX_AFTERFLOW_S = 10.0
# A level further below 0 (m) is not noise: a tank would seem empty.
_LEVEL_NOISE = 0.1
_MODBUS_PORT = 502
_PATH = re.compile(r"([^.\[\]]+|\[\d+\])(\.[^.\[\]]+|\[\d+\])*")


class MeasuredQuantity(NamedTuple):
    """A quantity that a sensor measures.

    Attributes:
        node: name of the node that publishes it.
        topic_name: name of its topic in the interface, which states its unit and range.
        spread_s: longest time over which a rise of its total is spread (s).
    """

    node: str
    topic_name: str
    spread_s: float = math.inf

    @property
    def topic(self) -> Topic:
        """Its topic."""
        return read_topics()[self.topic_name]

    @property
    def limit(self) -> str:
        """The parameter that sets its maximum age."""
        age = self.topic.max_age
        assert age is not None
        return age.parameter


# The quantities, by section of the file.
QUANTITIES = {
    "cistern": MeasuredQuantity("cistern_sensor", "/cistern/level"),
    "roof": MeasuredQuantity("roof_sensor", "/roof/level"),
    "flow_meter": MeasuredQuantity("flow_meter", "/pump/meter", _MAX_AFTERFLOW_S / 2),
    "rain_gauge": MeasuredQuantity("rain_gauge", "/gauge/precipitation"),
    "thermometer": MeasuredQuantity("thermometer", "/gauge/temperature"),
}


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """The keys that all sensors share. The value is the median of converted readings."""

    scale: float = entry("value = scale x raw + offset, in the quantity's unit", -1e3, 1e3)
    low: float = entry(
        "lowest accepted value, in the quantity's unit; below 0 for the noise of a sensor at 0, "
        "which is treated as 0 (not for a temperature)", -100, 100,
    )
    high: float = entry("highest accepted value, in the same unit", -100, 100)
    offset: float = entry("value at raw 0, in the same unit", -1e3, 1e3, default=0.0)
    median: int = entry(
        "number of readings in the median, which must be odd; 1 for no filter", 1, 99, default=5
    )
    counts: bool = entry(
        "if true, scale x raw is a running total (m or m3), whose increase per second is the "
        "value; needs "
        "median: 1", default=False,
    )
    substrate_depth: float | None = entry(
        "for the roof only: if set, scale x raw + offset is a volumetric moisture content "
        "(m3/m3), and the level is this content times this depth (m), which must be z_soil of the "
        "site", 0.01, 2, default=None,
    )

    def convert(self, raw: float) -> float:
        """Return the quantity for a raw value; does not apply to totals."""
        return (self.scale * raw + self.offset) * (self.substrate_depth or 1.0)

    def raw_for(self, value: float) -> float:
        """Return the raw value at which :meth:`convert` returns this value."""
        return (value / (self.substrate_depth or 1.0) - self.offset) / self.scale


@dataclass(frozen=True, kw_only=True)
class ModbusSensor(Sensor):
    """A sensor that is read over Modbus."""

    address: str = entry("tcp://HOST:PORT, or a serial device such as /dev/ttyUSB0")
    device_id: int = entry("unit identifier or slave address", 0, 255)
    register: int = entry("its address on the wire, where the first register is 0", 0, 65535)
    kind: str = entry(
        "input registers (function 4) or holding registers (3)", choices=("input", "holding")
    )
    type: str = entry("how the value is encoded", choices=tuple(WIDTHS))
    word_order: str = entry("which word comes first, if there are "
        "several", choices=WORD_ORDERS, default="")
    missing: Word | None = entry("the raw value that means 'no reading'", default=None)
    period: float = entry(
        "time between two readings (s); at most half of the maximum age of the quantity", 0.05,
        3600, default=1.0,
    )
    baud_rate: int = entry("serial line only: bits per second", 1200, 1_000_000, default=19200)
    parity: str = entry(
        "serial line only: parity bit", choices=("even", "odd", "none"), default="even"
    )
    stop_bits: int = entry("serial line only: stop bits", 1, 2, default=1)

    def __str__(self) -> str:
        return f"{self.address}, device {self.device_id}"

    @property
    def connection(self) -> str:
        """Its serial line or TCP port, equal for all sensors that one connection reaches."""
        address = parse_address(self.address)
        if address.line:
            return str(Path(address.line).resolve())
        return f"{address.host}:{address.port or _MODBUS_PORT}"

    @property
    def unique_key(self) -> tuple[object, ...]:
        """Its register, which no two sensors may share."""
        return self.connection, self.device_id, self.kind, self.register

    @property
    def serial(self) -> Serial:
        """The settings of a serial line."""
        return Serial(self.baud_rate, self.parity, self.stop_bits, self.device_id)

    @property
    def registers(self) -> int:
        """The number of registers that the value takes."""
        return WIDTHS[self.type]

    def line(self, timeout_s: float) -> ModbusLine:
        """Return a connection to it, not yet opened.

        Args:
            timeout_s: maximum wait for a connection, and for each answer (s).
        """
        return ModbusLine(
            parse_address(self.address), port=_MODBUS_PORT, device_id=self.device_id,
            serial=self.serial, timeout_s=timeout_s,
        )


@dataclass(frozen=True, kw_only=True)
class MqttSensor(Sensor):
    """A sensor that publishes to an MQTT broker."""

    address: str = entry("mqtt://HOST[:PORT]/TOPIC; mqtts:// over TLS")
    value: str = entry(
        "where in a JSON message the number is, such as ANALOG.Range1 or "
        "sensors[0].distance; omit it if the message itself is the number", default="",
    )
    max_age: float = entry(
        "how long the sensor may be silent (s); at most the maximum age of the quantity",
        0.1, 3600,
    )
    login: str = entry(
        "absolute path of a file with username and password, which no other user may read (chmod "
        "600)",
        default="",
    )
    authority: str = entry(
        "absolute path of a file of trusted certificates (PEM); if omitted, the system's "
        "certificates are used",
        default="",
    )

    def __str__(self) -> str:
        return self.address

    @staticmethod
    def fits(section: Mapping[str, Any]) -> bool:
        """Whether a section of the file describes such a sensor, judging by its address."""
        return str(section.get("address")).startswith(("mqtt://", "mqtts://"))

    @property
    def unique_key(self) -> tuple[object, ...]:
        """Its topic and the path of the value, which no two sensors may share."""
        try:
            broker, topic = self.broker_and_topic()
        except ConfigurationError:  # another check reports this
            return (self.address,)
        return broker.host, broker.port, topic, self.value

    def broker_and_topic(self) -> tuple[Broker, str]:
        """Return where the broker is, and the topic.

        Raises:
            ConfigurationError: if the address is wrong.
        """
        return parse_topic(self.address, "address", self.login, self.authority)


@dataclass(frozen=True)
class Sensors:
    """The sensors of a site."""

    cistern: ModbusSensor | MqttSensor = entry("level of the cistern (m)")
    roof: ModbusSensor | MqttSensor = entry("level of the roof (m)")
    flow_meter: ModbusSensor | MqttSensor | None = entry("flow of the pump (m3/s)", default=None)
    rain_gauge: ModbusSensor | MqttSensor | None = entry("rain (m/s)", default=None)
    thermometer: ModbusSensor | MqttSensor | None = entry(
        "temperature of the air (degC)", default=None
    )

    @property
    def by_section(self) -> dict[str, ModbusSensor | MqttSensor]:
        """The sensors that the site has, by section of the file."""
        return {name: sensor for name in QUANTITIES if (sensor := getattr(self, name)) is not None}


def default_sensors() -> Path:
    """Return the sensor file that is shipped with the package."""
    return shared_directory() / "config" / "sensors.yaml"


def read_sensors(path: Path, max_ages: Mapping[str, float] | None = None) -> Sensors:
    """Read and check a sensor file.

    Args:
        path: the file.
        max_ages: ages beyond which quantities are not used (s), where known, by name of their
            parameters. Two periods, or one ``max_age``, must fit into them.

    Raises:
        ConfigurationError: if something in it is missing, unknown, impossible or contradictory.
    """
    return read_record(Sensors, path, lambda sensors, _: _mistakes(sensors, max_ages or {}))


def _mistakes(
    sensors: Sensors, max_ages: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    """Yield every key with a mistake, and the reason; later checks rely on the earlier ones."""
    for section, sensor in sensors.by_section.items():
        quantity = QUANTITIES[section]
        max_age = max_ages.get(quantity.limit, math.inf)
        mistakes = (
            _modbus_mistakes(sensor, quantity, max_age) if isinstance(sensor, ModbusSensor)
            else _mqtt_mistakes(sensor, quantity, max_age)
        )
        for key, expected in (*_sensor_mistakes(sensor, section), *mistakes):
            yield f"{section}.{key}", expected
    for (first, earlier), (second, later) in combinations(sensors.by_section.items(), 2):
        of = first.replace("_", " ")
        if earlier.unique_key == later.unique_key:
            key = "register" if isinstance(later, ModbusSensor) else "address"
            yield f"{second}.{key}", (
                f"is also the {key} of the {of}: both sensors would be the same"
            )
        if isinstance(earlier, ModbusSensor) and isinstance(later, ModbusSensor) and parse_address(
            later.address
        ).shares_line(parse_address(earlier.address)):
            if later.device_id == earlier.device_id:
                yield f"{second}.device_id", (
                    f"is also the device id of the {of} on the same serial line: a late answer "
                    "would be taken for the other's; give each sensor a slave address of its own"
                )
            for key in ("baud_rate", "parity", "stop_bits"):
                if getattr(later, key) != (value := getattr(earlier, key)):
                    yield f"{second}.{key}", f"must be {value}, as for the {of} on the same line"


def _sensor_mistakes(sensor: Sensor, section: str) -> Iterator[tuple[str, str]]:
    topic = QUANTITIES[section].topic
    if sensor.scale == 0:
        yield "scale", "must not be 0"
    if sensor.low >= sensor.high:
        yield "high", f"must be above low, {sensor.low:g} {topic.unit}"
    if section in TANKS and sensor.low < topic.low - _LEVEL_NOISE:
        yield "low", (
            f"must be at least {topic.low - _LEVEL_NOISE:g} {topic.unit}: a level further below "
            f"{topic.low:g} is not the noise of a sensor"
        )
    if sensor.high > topic.high:
        yield "high", f"must be at most {topic.high:g} {topic.unit}: higher values are not accepted"
    if sensor.median % 2 == 0:
        yield "median", "must be odd, so that the median is one of the readings"
    if sensor.substrate_depth is not None and section != "roof":
        yield "substrate_depth", "is only for the roof"
    if sensor.substrate_depth is not None and sensor.high > sensor.substrate_depth:
        yield "high", (
            f"must be at most substrate_depth, {sensor.substrate_depth:g} m: the substrate cannot "
            "hold more water than its volume"
        )
    if sensor.counts and section not in ("flow_meter", "rain_gauge"):
        yield "counts", "is only for a flow meter or a rain gauge"
    if sensor.counts and sensor.median > 1:
        yield "counts", "needs median: 1, because a median removes occasional pulses"


def _period_mistakes(
    sensor: Sensor, quantity: MeasuredQuantity, interval: float
) -> Iterator[tuple[str, str]]:
    late = sensor.median // 2 * interval
    shown = late + interval
    if quantity is QUANTITIES["flow_meter"] and shown > _MAX_AFTERFLOW_S:
        yield "median", (
            f"shows a flow for up to {shown:g} s after it has stopped, with {interval:g} s from "
            f"one reading to the next; more than {_MAX_AFTERFLOW_S:g} s would look like a "
            "welded contact"
        )
    if late > _MAX_FILTER_S:
        yield "median", (
            f"delays the value by {late:g} s, with {interval:g} s from one reading to the next; "
            f"at most {_MAX_FILTER_S:g} s is sensible"
        )


def _modbus_mistakes(
    sensor: ModbusSensor, quantity: MeasuredQuantity, max_age: float
) -> Iterator[tuple[str, str]]:
    try:
        parse_address(sensor.address)
    except ConfigurationError as error:
        yield "address", f"{error.expected}; or mqtt://HOST[:PORT]/TOPIC"
    yield from coding_mistakes(sensor.type, sensor.word_order)
    if sensor.register + sensor.registers > 65536:
        yield "register", "leaves too little room for all its registers"
    ends = sorted(map(sensor.convert, limits(sensor.type)))
    step, unit = abs(sensor.scale) * (sensor.substrate_depth or 1.0), quantity.topic.unit
    if not sensor.counts and (ends[0] > sensor.low + step or ends[1] < sensor.high - step):
        yield "scale", (
            f"cannot yield {sensor.low:g} to {sensor.high:g} {unit}: {sensor.type} with offset "
            f"{sensor.offset:g} yields {ends[0]:g} to {ends[1]:g} {unit}"
        )
    yield from _period_mistakes(sensor, quantity, sensor.period)
    if sensor.period > max_age / 2:
        yield "period", (
            f"must be at most {max_age / 2:g} s, half of {quantity.limit}: older values are "
            "not used"
        )


def _mqtt_mistakes(
    sensor: MqttSensor, quantity: MeasuredQuantity, max_age: float
) -> Iterator[tuple[str, str]]:
    try:
        sensor.broker_and_topic()
    except ConfigurationError as error:
        yield "address", error.expected
        return
    if sensor.value and not _PATH.fullmatch(sensor.value):
        yield "value", "must be names and numbers, such as ANALOG.Range1 or sensors[0].distance"
    for key in ("login", "authority"):
        file = getattr(sensor, key)
        if file and not Path(file).is_absolute():
            yield key, "must be an absolute path: a copy of this file is read"
    yield from _period_mistakes(sensor, quantity, sensor.max_age)
    if sensor.max_age > max_age:
        yield "max_age", (
            f"must be at most {max_age:g} s, {quantity.limit}: older values are not used"
        )
