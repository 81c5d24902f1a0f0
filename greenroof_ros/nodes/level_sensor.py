"""The level sensor node of a tank: a sensor on Modbus read, its level published.

``python -m greenroof_ros.nodes.level_sensor --tank cistern`` publishes /cistern/level, ``--tank
roof`` /roof/level, once in the period of ``config/sensors.yaml``. Where a reading is bad nothing is
published, and /diagnostics says why: who acts on the level finds it too old.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.drives.level_sensor import LevelSensor
from greenroof_ros.drives.sensor_file import TANKS, default_sensors, read_sensors
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.link import LinkedNode
from greenroof_ros.graph.live import LIMITS
from greenroof_ros.graph.parameters import declare
from greenroof_ros.graph.reports import STALE
from greenroof_ros.model.site import Site

_LIMIT = LIMITS["/cistern/level"]
# After so many periods without any reading, good or bad, the reader hangs.
_PERIODS = 5


def parameters(site: Site | None = None) -> list[Parameter]:
    """Return the node's parameters, which are the same at every site."""
    sensors = str(default_sensors())
    return [
        Parameter("sensors_file", sensors, meaning="what the sensors are like, and where"), _LIMIT,
    ]


class LevelSensorNode(LinkedNode):
    """Publishes what a sensor reads."""

    def __init__(self, tank: str) -> None:
        """Read the sensor's file, and begin to read the sensor.

        Args:
            tank: ``cistern`` or ``roof``.
        """
        super().__init__(f"{tank}_sensor", f"{tank}_sensor", live=True)
        values = declare(self, parameters())
        sensors = read_sensors(Path(values["sensors_file"]), values[_LIMIT.name])
        self._sensor = sensors.cistern if tank == "cistern" else sensors.roof
        self._topic = f"/{tank}/level"
        self.open_outputs(self._topic)
        self._level: float | None = None
        self._started = self._published = time.monotonic()
        self.reports.hardware = f"{self._sensor.address}, device {self._sensor.device_id}"
        self._reader = LevelSensor(self._sensor)
        self._reader.start()

    def on_idle(self) -> None:
        """Publish a new reading that is good; say why another one is not."""
        reading, now = self._reader.snapshot, time.monotonic()
        if now - max(reading.read_at, self._started) > _PERIODS * self._sensor.period:
            self._level = None
            self.diagnose(
                "sensor", STALE, "the sensor is not read any more: the reader hangs",
                "sensor_hangs",
            )
        elif reading.read_at > self._published:
            self._published = reading.read_at
            self._level = reading.level
            self.reports.numbers["sensor"] = {"level": reading.level}
            if reading.level is not None:
                self.publish(self._topic, reading.level)
            self.say("sensor", reading.problem, "the sensor is read", "sensor_lost")

    def progress(self) -> dict[str, Any]:
        """Return what bringup shows."""
        return {"level": self._level}

    def on_stop(self) -> None:
        """Let go of the sensor."""
        self._reader.close()


def _help(tank: str | None) -> str:
    return node_help(
        f"level_sensor --tank {tank or 'TANK'}", f"{tank or TANKS[0]}_sensor",
        f"{__doc__}\nTANK is {' or '.join(TANKS)}.", parameters,
        "--ros-args -p sensors_file:=my_sensors.yaml",
    )


main = node_command(LevelSensorNode, _help, "--tank", TANKS)


if __name__ == "__main__":
    main()
