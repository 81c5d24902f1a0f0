"""The level sensors of a site: ``config/sensors.yaml``, as frozen dataclasses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_yaml, shared_directory
from greenroof_ros.common.records import Entry, Word, error_at, read_record
from greenroof_ros.drives.address import Serial, parse_address
from greenroof_ros.drives.modbus_line import ModbusLine
from greenroof_ros.drives.values import WIDTHS, WORD_ORDERS, limits

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

    address: Annotated[str, Entry("tcp://HOST:PORT, or a serial device such as /dev/ttyUSB0")]
    device_id: Annotated[int, Entry("unit identifier or slave address", low=0, high=255)]
    register: Annotated[
        int, Entry("its address on the wire, the first register is 0", low=0, high=65535)
    ]
    kind: Annotated[
        str, Entry("input registers (function 4) or holding (3)", choices=("input", "holding"))
    ]
    type: Annotated[str, Entry("how the value is coded", choices=tuple(WIDTHS))]
    scale: Annotated[float, Entry("level = scale x raw + offset; m per count", low=-1e3, high=1e3)]
    low: Annotated[float, Entry("least level that is accepted (m)", low=-10, high=100)]
    high: Annotated[float, Entry("greatest level that is accepted (m)", low=-10, high=100)]
    offset: Annotated[float, Entry("level where raw is 0 (m)", low=-100, high=100)] = 0.0
    word_order: Annotated[
        str, Entry("which half of 32 bits comes first", choices=WORD_ORDERS)
    ] = ""
    missing: Annotated[Word | None, Entry("the raw value that says 'no reading'")] = None
    median: Annotated[
        int, Entry("readings of which the median is taken, an odd number; 1: no filter", low=1,
                   high=99)
    ] = 5
    period: Annotated[float, Entry(
        "from one reading to the next (s); at most half of level_limit", low=0.05, high=3600
    )] = 1.0
    baud_rate: Annotated[
        int, Entry("of a serial line: bits per second", low=1200, high=1_000_000)
    ] = 19200
    parity: Annotated[
        str, Entry("of a serial line: parity bit", choices=("even", "odd", "none"))
    ] = "even"
    stop_bits: Annotated[int, Entry("of a serial line: stop bits", low=1, high=2)] = 1

    @property
    def serial(self) -> Serial:
        """The settings of a serial line."""
        return Serial(self.baud_rate, self.parity, self.stop_bits, self.device_id)

    def connection(self, timeout_s: float) -> ModbusLine:
        """Return a connection to it, not yet opened.

        Args:
            timeout_s: longest wait for a connection, and for each answer (s).
        """
        return ModbusLine(
            parse_address(self.address), port=_MODBUS_PORT, device_id=self.device_id,
            serial=self.serial, timeout_s=timeout_s,
        )

    @property
    def registers(self) -> int:
        """How many registers the value takes."""
        return WIDTHS[self.type]


@dataclass(frozen=True)
class Sensors:
    """The sensors of both tanks."""

    cistern: Annotated[Sensor, Entry("level sensor of the cistern")]
    roof: Annotated[Sensor, Entry("level sensor of the roof")]


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
    wrong = [
        (f"{tank}.{key}", expected)
        for tank in TANKS
        for key, expected in _mistakes(getattr(sensors, tank), level_limit)
    ]
    cistern, roof = sensors.cistern, sensors.roof
    if not wrong and parse_address(roof.address).shares_line(parse_address(cistern.address)):
        wrong.append((
            "roof.address",
            "is the cistern's serial line, which one program alone can open: put a Modbus TCP "
            "gateway on it (tcp://HOST:PORT), or take another line",
        ))
    if _place(cistern) == _place(roof):
        wrong.append(("roof.register", "is the cistern's: both sensors would be the same"))
    for key, expected in wrong:
        tank, _, name = key.partition(".")
        raise error_at(path, content, key, content[tank].get(name), expected)
    return sensors


def _place(sensor: Sensor) -> tuple[object, ...]:
    return sensor.address, sensor.device_id, sensor.kind, sensor.register


def _mistakes(sensor: Sensor, level_limit: float) -> Iterator[tuple[str, str]]:
    """Yield each key that cannot be as it is, and why."""
    try:
        parse_address(sensor.address)
    except ConfigurationError as error:
        yield "address", str(error).rpartition(": ")[2]
    wide = sensor.registers == 2
    if wide != bool(sensor.word_order):
        yield "word_order", (
            "must be 'high first' or 'low first'" if wide
            else f"does not belong to {sensor.type}, which is one register"
        )
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
