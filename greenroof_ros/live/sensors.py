"""The nodes of all sensors, which publish the sensors' readings from a single process.

``python -m greenroof_ros.live.sensors --sensors sensors.yaml`` creates a node for every section of
the file, such as /cistern_sensor, which publishes /cistern/level. A node publishes once per period
for a Modbus sensor, and at every message for an MQTT sensor. An invalid reading is not published,
and the reason is reported on /diagnostics; the last value then becomes too old for its subscribers.
"""

from __future__ import annotations

from greenroof_ros.ros import begin_node

begin_node(__name__)

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.devices.sensor import ModbusReader, MqttReader, SensorLine
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS, ModbusSensor, read_sensors
from greenroof_ros.live.levels import LIMITS
from greenroof_ros.live.node import LiveNode, live_command
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import declare


def parameters(site: object = None) -> list[Parameter]:
    """Return the parameters of sensor nodes, which are the same at every site."""
    return list(dict.fromkeys(LIMITS[quantity.topic_name] for quantity in QUANTITIES.values()))


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
        quantity = QUANTITIES[section]
        super().__init__(quantity.node, quantity.node)
        values = declare(self, parameters())
        sensor = read_sensors(file, values).by_section[section]
        self._topic, unit = quantity.topic_name, quantity.topic.unit
        self._lowest = quantity.topic.low
        # A missing level stops the pump; other missing quantities may not.
        self._part, self._level = ("sensor", ERROR) if section in TANKS else ("gauge", WARN)
        self.open_outputs(self._topic)
        self._newest: float | None = None
        self._published = boot_time()
        self.reports.hardware = str(sensor)
        self._reader: ModbusReader | MqttReader
        if isinstance(sensor, ModbusSensor):
            line, age = lines[sensor.connection], values[quantity.limit]
            self._reader = ModbusReader(sensor, unit, line, age, quantity.spread_s)
        else:
            self._reader = MqttReader(quantity.node, sensor, unit, quantity.spread_s)

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


def sensor_nodes(file: str) -> list[LiveNode]:
    """Return a node for each sensor in a file.

    Raises:
        ConfigurationError: if the file or a parameter is invalid, or a library is missing.
    """
    return [make() for make in sensor_makers(Path(file))]


main = live_command(sensor_nodes, __doc__, "--sensors")


if __name__ == "__main__":
    main()
