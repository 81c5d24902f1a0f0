"""The level sensors of a site: ``config/sensors.yaml``, as frozen dataclasses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.parameter import Word, entry, error_at, read_record
from greenroof_ros.drives.modbus_line import (
    WIDTHS,
    WORD_ORDERS,
    ModbusLine,
    Serial,
    coding_mistakes,
    limits,
    parse_address,
)

TANKS = ("cistern", "roof")
_LONGEST_FILTER_S = 30.0
_MODBUS_PORT = 502


@dataclass(frozen=True)
class Sensor:
    """A level sensor. The level is scale x raw + offset (m), the median of some readings.

    A median, not a first-order filter: it leaves single wrong readings out, where the other spreads
    them over many; and it follows a level that moves steadily, later by half its readings, without
    rounding off where it begins to move. Levels of tanks are slow enough for that.
    """

    address: str = entry("tcp://HOST:PORT, or a serial device such as /dev/ttyUSB0")
    device_id: int = entry("unit identifier or slave address", 0, 255)
    register: int = entry("its address on the wire, the first register is 0", 0, 65535)
    kind: str = entry(
        "input registers (function 4) or holding (3)", choices=("input", "holding")
    )
    type: str = entry("how the value is coded", choices=tuple(WIDTHS))
    scale: float = entry("level = scale x raw + offset; m per count", -1e3, 1e3)
    low: float = entry("least level that is accepted (m)", -10, 100)
    high: float = entry("greatest level that is accepted (m)", -10, 100)
    offset: float = entry("level where raw is 0 (m)", -100, 100, default=0.0)
    word_order: str = entry("which half of 32 bits comes first", choices=WORD_ORDERS, default="")
    missing: Word | None = entry("the raw value that says 'no reading'", default=None)
    median: int = entry(
        "readings of which the median is taken, an odd number; 1: no filter", 1, 99, default=5
    )
    period: float = entry(
        "from one reading to the next (s); at most half of level_limit", 0.05, 3600, default=1.0
    )
    baud_rate: int = entry("of a serial line: bits per second", 1200, 1_000_000, default=19200)
    parity: str = entry(
        "of a serial line: parity bit", choices=("even", "odd", "none"), default="even"
    )
    stop_bits: int = entry("of a serial line: stop bits", 1, 2, default=1)

    @property
    def serial(self) -> Serial:
        """The settings of a serial line."""
        return Serial(self.baud_rate, self.parity, self.stop_bits, self.device_id)

    @property
    def registers(self) -> int:
        """How many registers the value takes."""
        return WIDTHS[self.type]

    def line(self, timeout_s: float) -> ModbusLine:
        """Return a connection to it, not yet opened.

        Args:
            timeout_s: longest wait for a connection, and for each answer (s).
        """
        return ModbusLine(
            parse_address(self.address), port=_MODBUS_PORT, device_id=self.device_id,
            serial=self.serial, timeout_s=timeout_s,
        )


@dataclass(frozen=True)
class Sensors:
    """The sensors of both tanks."""

    cistern: Sensor = entry("level sensor of the cistern")
    roof: Sensor = entry("level sensor of the roof")


def default_sensors() -> Path:
    """Return the file of the package's own."""
    return shared_directory() / "config" / "sensors.yaml"


def read_sensors(path: Path, level_limit: float = math.inf) -> Sensors:
    """Read a file of sensors and check it.

    Args:
        path: the file.
        level_limit: age beyond which nobody takes a level (s); two readings must fit into it.

    Raises:
        ConfigurationError: something in it is missing, unknown, impossible, or contradicts
            something else in it.
    """
    content = read_yaml(path)
    sensors = read_record(Sensors, path, content)
    for key, expected in _mistakes(sensors, level_limit):
        raise error_at(path, content, key, expected)
    return sensors


def _mistakes(sensors: Sensors, level_limit: float) -> Iterator[tuple[str, str]]:
    """Yield each key that contradicts another one, and why; what follows goes by those before."""
    for tank in TANKS:
        for key, expected in _sensor_mistakes(getattr(sensors, tank), level_limit):
            yield f"{tank}.{key}", expected
    cistern, roof = sensors.cistern, sensors.roof
    if parse_address(roof.address).shares_line(parse_address(cistern.address)):
        yield "roof.address", (
            "is the cistern's serial line, which one program alone can open: put a Modbus TCP "
            "gateway on it (tcp://HOST:PORT), or take another line"
        )
    places = {(each.address, each.device_id, each.kind, each.register) for each in (cistern, roof)}
    if len(places) == 1:
        yield "roof.register", "is the cistern's: both sensors would be the same"


def _sensor_mistakes(sensor: Sensor, level_limit: float) -> Iterator[tuple[str, str]]:
    try:
        parse_address(sensor.address)
    except ConfigurationError as error:
        yield "address", str(error).rpartition(": ")[2]
    yield from coding_mistakes(sensor.type, sensor.word_order)
    if sensor.register + sensor.registers > 65536:
        yield "register", "leaves no room for a second register"
    if sensor.scale == 0:
        yield "scale", "must not be 0"
    if sensor.low >= sensor.high:
        yield "high", f"must be above low, {sensor.low:g} m"
    ends = sorted(sensor.scale * raw + sensor.offset for raw in limits(sensor.type))
    if ends[0] > sensor.low + abs(sensor.scale) or ends[1] < sensor.high - abs(sensor.scale):
        yield "scale", (
            f"cannot give the levels from {sensor.low:g} to {sensor.high:g} m: {sensor.type} with "
            f"offset {sensor.offset:g} goes from {ends[0]:g} to {ends[1]:g} m"
        )
    if sensor.median % 2 == 0:
        yield "median", "must be odd, so that it is one of the readings"
    late = sensor.median // 2 * sensor.period
    if late > _LONGEST_FILTER_S:
        yield "median", (
            f"is late by {late:g} s with a period of {sensor.period:g} s; at most "
            f"{_LONGEST_FILTER_S:g} s are sensible"
        )
    if sensor.period > level_limit / 2:
        yield "period", (
            f"must be at most {level_limit / 2:g} s, half of level_limit: beyond that age nobody "
            "takes the level, and the pump stands"
        )
