"""The station: one process with the nodes that drive no pump or valve and run no user's code.

``python -m greenroof_ros.live.station --sensors sensors.yaml --weather`` creates a node for every
section of the sensor file, the weather node, the recorder and the alarms node. A node that fails is
destroyed and made again, after 1, 2, 4, 8 and 10 s, while the others go on. A node that fails more
than ten times in ten minutes is left out until the site is restarted; its failure stays an alarm.
Without the alarms node, and if a node hangs, bringup restarts the process.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from greenroof_ros.base.command_line import Parser, command, print_failure
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.standard_error import Lines
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.devices.sensor import ModbusReader, MqttReader, SensorLine
from greenroof_ros.live.devices.sensor_file import QUANTITIES, TANKS, ModbusSensor, read_sensors
from greenroof_ros.live.live_input import LIMITS
from greenroof_ros.live.node import LiveNode, spin
from greenroof_ros.live.recorder import LiveRecorderNode
from greenroof_ros.live.upkeep import Restarts, send_beat
from greenroof_ros.live.weather import LiveWeatherNode
from greenroof_ros.nodes.alarms import AlarmsNode
from greenroof_ros.ros.diagnostics import ERROR, WARN
from greenroof_ros.ros.parameters import declare
from greenroof_ros.ros.spin import end_nodes, parse_own_arguments, run_nodes


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


Make = Callable[[], LiveNode | AlarmsNode]


def keep_nodes(
    makers: Sequence[Make], nodes: list[LiveNode | AlarmsNode], check: Callable[[], None]
) -> None:
    """Run nodes, and make those again that fail, until a check ends them.

    Args:
        makers: functions that make the nodes; the last one makes the alarms node.
        nodes: the nodes, in the same order; from then on, those that are running.
        check: function that is called at least 20 times a second and may raise an exception.
    """
    made = dict(zip(makers, nodes, strict=True))
    restarts = {make: Restarts() for make in makers}

    def postpone(make: Make, error: Exception) -> str:
        """Set when a node is made again; return why it failed."""
        restarts[make].postpone(time.monotonic())
        if make is makers[-1] and math.isinf(restarts[make].due):
            raise error  # nobody else reports an alarm
        return print_failure(error)[0]

    def fail(node: LiveNode | AlarmsNode, error: Exception) -> None:
        make = next(make for make, each in made.items() if each is node)
        failure = postpone(make, error)
        nodes.remove(made.pop(make))
        end_nodes([node], failure)
        node.destroy_node()

    def make_due() -> None:
        check()
        if not any(isinstance(node, LiveNode) for node in nodes):
            send_beat(False)  # the alarms node sends none
        for make in makers:
            if make not in made and time.monotonic() >= restarts[make].due:
                try:
                    made[make] = make()
                except Exception as error:
                    postpone(make, error)
                else:
                    nodes.append(made[make])

    spin(nodes, make_due, fail)


@command
def main() -> int:
    """Run the nodes."""
    parser = Parser(description=__doc__)
    parser.add_argument("--sensors", type=Path, help="sensor file")
    parser.add_argument("--weather", action="store_true", help="run the weather node")
    arguments = parse_own_arguments(parser)
    # In the order in which they end.
    makers: list[Make] = [LiveRecorderNode, partial(AlarmsNode, Lines(1))]
    if arguments.weather:
        makers.insert(0, LiveWeatherNode)
    if arguments.sensors is not None:
        makers = [*sensor_makers(arguments.sensors), *makers]
    return run_nodes(lambda: [make() for make in makers], partial(keep_nodes, makers))


if __name__ == "__main__":
    main()
