"""The nodes of all sensors: one for every section of the sensor file.

A node such as /cistern_sensor publishes the readings of its sensor, such as /cistern/level: once
per period for a Modbus sensor, and at every message for an MQTT sensor. An invalid reading is not
published, and the reason is reported on /diagnostics; the last value then becomes too old for its
subscribers.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.sensor import ModbusReader, MqttReader, SensorLine
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS, ModbusSensor, read_sensors
from greenroof_ros.live.live_input import LIMITS
from greenroof_ros.live.node import LiveNode
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import declare


def parameters(site: object = None) -> list[Parameter]:
    """Return the parameters of sensor nodes, which are the same at every site."""
    return list(dict.fromkeys(LIMITS[quantity.name] for quantity in QUANTITIES.values()))


class SensorNode(LiveNode):
    """Node that publishes the readings of a sensor."""

    def __init__(self, section: str, file: Path, lines: defaultdict[str, SensorLine]) -> None:
        """Read the sensor's section, without connecting to the sensor yet.

        Args:
            section: section of the file, such as ``cistern``.
            file: the sensor file.
            lines: the lines of the Modbus sensors, by connection; this sensor is added to them.

        Raises:
            ConfigurationError: if the file is invalid.
        """
        topic = QUANTITIES[section]
        (name,) = topic.live_publishers
        super().__init__(name, name)
        values = declare(self, parameters())
        sensor = read_sensors(file, values).by_section[section]
        self._topic, self._lowest = topic.name, topic.low
        # A missing level stops the pump; other missing quantities may not.
        self._part, self._level = ("sensor", ERROR) if section in TANKS else ("gauge", WARN)
        self.open_outputs(self._topic)
        self._newest: float | None = None
        self._published = boot_time()
        self.reports.hardware = str(sensor)
        self._reader: ModbusReader | MqttReader
        if isinstance(sensor, ModbusSensor):
            line, age = lines[sensor.place.connection], values[LIMITS[topic.name].name]
            self._reader = ModbusReader(section, sensor, line, age)
        else:
            self._reader = MqttReader(section, sensor)

    def on_start(self) -> None:
        """Start reading the sensor."""
        self._reader.start()

    def on_timer(self, now: float) -> None:
        """Publish every new valid reading, and report the reason for an invalid reading."""
        reading = self._reader.snapshot
        if reading.read_at > self._published or reading.value != self._newest:
            self._newest, self._published = reading.value, reading.read_at
            if reading.value is not None:
                # An empty tank or a stopped pump may read slightly below 0 because of noise or a
                # shifted zero.
                self.publish(self._topic, max(reading.value, self._lowest))
        problem = Diagnosis.if_any(reading.code, reading.problem)
        self.reports.diagnose(self._part, problem, "the sensor is being read", self._level)

    def on_stop(self) -> None:
        """Stop reading the sensor."""
        self._reader.close()


def sensor_makers(file: Path) -> list[Callable[[], LiveNode]]:
    """Return a function for each sensor in a file that makes the sensor's node.

    Raises:
        ConfigurationError: if the file is invalid.
    """
    lines: defaultdict[str, SensorLine] = defaultdict(SensorLine)
    return [
        partial(SensorNode, section, file, lines) for section in read_sensors(file).by_section
    ]

