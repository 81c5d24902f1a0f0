"""A site that is simulated tick by tick; all simulations use this module to compute a tick.

Simulations in a single process, the plans of the bound and the plant node of the ROS graph all use
a :class:`VirtualSite`. In every tick, a controller reads the levels and decides on a command, and
the site executes the command and proceeds to the next tick.
"""

from __future__ import annotations

from greenroof_ros.physics.plant import Flows, Plant
from greenroof_ros.physics.sensor_and_pump import Pump, RoofSensor, SensorAndPump
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.site.site import Site


class VirtualSite:
    """A cistern and a roof with level sensors, the pumps, and the metrics of the run.

    Attributes:
        plant: the true state of the cistern and the roof.
        metrics: metrics of all previous ticks, as if the run ended with the current tick.
        tick: number of the current tick.
        frost: 0 without frost in the current tick; any other value, including NaN, means frost. The
            caller sets this attribute.
        quiet: whether the current tick is within the site's quiet hours.
    """

    def __init__(
        self, site: Site, x1: float, x2: float, start_ns: int, sensor_and_pump: SensorAndPump
    ) -> None:
        """Start with tick 0.

        Args:
            site: parameters of the site.
            x1: initial volume in the cistern (m3).
            x2: initial volume on the roof (m3).
            start_ns: time of tick 0 (ns since 1970).
            sensor_and_pump: imperfections of the level sensor and the pumps.
        """
        self.plant = Plant(site, x1, x2)
        self.metrics = Metrics(site, self.plant, start_ns / 1e9)
        self.tick = 0
        self.frost = 0.0
        self._start_ns, self._tick_ns = start_ns, round(site.tau * 1e9)
        self._sensor = None if sensor_and_pump.exact_sensor else RoofSensor(sensor_and_pump)
        self._pump = None if sensor_and_pump.instant_pump else Pump(sensor_and_pump, site.tau)
        self._closed_in_frost = site.valve_closed_in_frost
        self._quiet_hours = site.quiet
        self.quiet = site.quiet is not None and site.quiet.quiet_at(start_ns)

    @property
    def time_ns(self) -> int:
        """The time of the current tick (ns since 1970)."""
        return self._start_ns + self.tick * self._tick_ns

    def observe(self) -> tuple[float, float]:
        """Return the readings of the cistern's and the roof's sensors in the current tick (m)."""
        cistern, roof = self.plant.levels()
        if self._sensor is not None:
            roof = self._sensor.reading(self.tick, roof)
        return cistern, roof

    def act(
        self, precipitation: float, evapotranspiration: float, command: float,
        pumped: float | None = None, outlet: float = 1.0,
    ) -> Flows:
        """Return the flows in the current tick; must be called exactly once per tick.

        Args:
            precipitation: rain rate (m/s).
            evapotranspiration: potential evapotranspiration from the whole bed (m3/s).
            command: command to the pumps (share of the maximum flow).
            pumped: flow (m3/s) of pumps that another program drives; None for the site's own pumps.
            outlet: command to the valve of the low outlet (opening, 0 to 1).
        """
        may_run = self.frost == 0 and not self.quiet
        if self._pump is None:
            switched = command if may_run else 0.0
        else:
            switched = self._pump.switch(command, may_run)
        if self._closed_in_frost and self.frost != 0:
            outlet = 0.0
        flows = self.plant.flows(precipitation, evapotranspiration, switched, pumped, outlet)
        if self._pump is not None:
            self._pump.observe(flows.pump)
        self._acted = command, precipitation, evapotranspiration, flows
        return flows

    def step(self) -> None:
        """Proceed to the next tick, after :meth:`act`."""
        command, precipitation, evapotranspiration, flows = self._acted
        self.metrics.step(command, precipitation, evapotranspiration, flows)
        self.plant.step(precipitation, flows)
        self.tick += 1
        if self._quiet_hours is not None:
            self.quiet = self._quiet_hours.quiet_at(self.time_ns)
