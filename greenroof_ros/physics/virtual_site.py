"""A site that is simulated tick by tick, whatever decides the commands.

The plant node of the ROS graph, the simulated devices of a live site, and simulations that are
stepped tick by tick in one process use a :class:`VirtualSite`; :mod:`.season` and the environments
have the same functions of numbers in loops of their own. In every tick, a controller reads the
levels and decides on a command, and the site executes the command and proceeds to the next tick.
"""

from __future__ import annotations

from greenroof_ros.physics.parameters import Flows, State, plant_parameters
from greenroof_ros.physics.pump import (
    SensorAndPump,
    make_switch,
    observe_pump,
    read_errors,
    switch_pump,
)
from greenroof_ros.physics.storm_water import make_valve, move_valve
from greenroof_ros.physics.tick import OWN_PUMPS, step
from greenroof_ros.site.site import Site


class VirtualSite:
    """A cistern and a roof with level sensors and the pumps.

    Attributes:
        state: the true state of the cistern and the roof.
        tick: number of the current tick.
        frost: 0 without frost in the current tick; any other value, including NaN, means frost. The
            caller sets this attribute.
        outlet: command to the low outlet's valve in the last tick; 0 if frost closed the valve.
    """

    def __init__(
        self, site: Site, x1: float, x2: float, start_ns: int, sensor_and_pump: SensorAndPump,
        ticks: int = 0,
    ) -> None:
        """Start with tick 0.

        Args:
            site: parameters of the site.
            x1: initial volume in the cistern (m3).
            x2: initial volume on the roof (m3).
            start_ns: time of tick 0 (ns since 1970).
            sensor_and_pump: imperfections of the level sensor and the pumps.
            ticks: number of ticks for which the sensor may have errors.
        """
        self.state = State(x1, x2, site.initial_layer)
        self.tick, self.frost = 0, 0.0
        self._site, self._parameters = site, plant_parameters(site)
        self._start_ns, self._tick_ns = start_ns, round(site.tau * 1e9)
        self._errors = read_errors(sensor_and_pump, ticks).tolist()
        self._switch = [*make_switch(sensor_and_pump, site.tau)]
        self._valve = [*make_valve(site.valve_moves_per_hour)]

    @property
    def time_ns(self) -> int:
        """The time of the current tick (ns since 1970)."""
        return self._start_ns + self.tick * self._tick_ns

    @property
    def quiet(self) -> bool:
        """Whether the current tick is within the site's quiet hours."""
        return self._site.quiet is not None and self._site.quiet.quiet_at(self.time_ns)

    def levels(self) -> tuple[float, float]:
        """Return the true levels of the cistern and the roof (m).

        The level of the roof is that in the substrate, without the water in the drainage layer.
        """
        return self.state.cistern / self._parameters.a1, self.state.roof / self._parameters.a2

    def observe(self) -> tuple[float, float]:
        """Return the readings of the cistern's and the roof's sensors in the current tick (m)."""
        cistern, roof = self.levels()
        if self._errors:
            roof = max(0.0, roof + self._errors[self.tick])
        return cistern, roof

    def act(
        self, precipitation: float, evapotranspiration: float, command: float,
        pumped: float = OWN_PUMPS, outlet: float = 1.0, other_demand: float = 0.0,
    ) -> Flows:
        """Return the flows in the current tick; must be called exactly once per tick.

        Args:
            precipitation: rain rate (m/s).
            evapotranspiration: potential evapotranspiration from the whole bed (m3/s).
            command: command to the pumps (share of the maximum flow).
            pumped: flow (m3/s) of pumps that another program drives; NaN for the site's own pumps.
            outlet: command to the valve of the low outlet (opening, 0 to 1).
            other_demand: water that other uses than the roof need (m3/s).
        """
        may_run = self.frost == 0 and not self.quiet
        switched = switch_pump(self._switch, command, may_run)
        closed = self.frost != 0 and self._parameters.valve_closed_in_frost
        self.outlet = 0.0 if closed else outlet
        self._after, flows = step(
            self._parameters, self.state, precipitation, evapotranspiration, switched,
            move_valve(self._valve, self._parameters.tau, self.outlet), pumped,
            other_demand,
        )
        observe_pump(self._switch, flows.pump)
        return flows

    def step(self) -> None:
        """Proceed to the next tick, after :meth:`act`."""
        self.state = self._after
        self.tick += 1
