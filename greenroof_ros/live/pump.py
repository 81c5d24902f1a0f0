"""The pump node of a live site.

It acts every tau of the site, on the newest values, and lets the pump run only on fresh, good ones.
:mod:`greenroof_ros.live.pump_behaviour` says what it does, and which services it has.
"""

from __future__ import annotations

from functools import partial

from greenroof_ros.common.conditions import Problem
from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import boot_time
from greenroof_ros.graph.executable import node_help
from greenroof_ros.graph.parameters import declare
from greenroof_ros.live import pump_behaviour
from greenroof_ros.live.engine import PAUSE_S, Levels, live_parameters
from greenroof_ros.live.executable import live_command
from greenroof_ros.live.node import LiveNode
from greenroof_ros.live.pump_behaviour import (
    COMMAND_LIMIT,
    PumpBehaviour,
    common_parameters,
    second_publisher,
)
from greenroof_ros.live.pumping.inputs import INPUTS
from greenroof_ros.model.site import Site


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [*common_parameters(site), *live_parameters(row.topic for row in INPUTS)]


class PumpNode(PumpBehaviour, LiveNode):
    """Runs the pump of a live site."""

    def __init__(self) -> None:
        """Declare the parameters, and open topics and services.

        Raises:
            ConfigurationError: a parameter, or the drive file, is wrong.
        """
        LiveNode.__init__(self, "pump", "pump")
        site = self.declare_site()
        values = declare(self, parameters(site))
        if values[COMMAND_LIMIT.name] <= site.tau:
            raise ConfigurationError(
                f"must be more than tau of the site, {site.tau:g} s: one command arrives per "
                "tau", key=f"parameter {COMMAND_LIMIT.name} of {self.get_name()}",
                value=values[COMMAND_LIMIT.name],
            )
        self._stepped = boot_time()
        command = self.subscribe("/pump/command", self._on_command)
        self._levels = Levels(site, values, self.subscribe)
        inputs = {
            "command": command, "cistern_level": self._levels.cistern,
            "roof_level": self._levels.roof,
        }
        inputs |= {
            row.name: self.subscribe(row.topic, optional=not row.unknown)
            for row in INPUTS if row.name not in inputs
        }
        self._own_flow = self.subscribe("/pump/flow", optional=True)
        PumpBehaviour.__init__(self, site, values, inputs, simulated=False)

    def _on_command(self, value: float) -> None:
        self._commanded_at = boot_time()

    def on_inputs(self) -> None:
        """Decide, and publish the flow."""
        self._step(boot_time())
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(self._decision.flow)
        self.publish("/pump/flow", self._decision.flow)

    def elapsed(self, now: float) -> float:
        """Return the time since the last call (s); a pause counts as one tick."""
        dt, self._stepped = now - self._stepped, now
        tau = self._site.tau
        if dt > tau + PAUSE_S:
            # All ticks since the last step were missed, except the present one.
            self._control.count_unseen(dt - tau)
            return tau
        return dt

    def displacements(self) -> tuple[float, float]:
        """Return how far impossible jumps have shifted both levels so far (m)."""
        return self._levels.displacements

    def second_pump(self) -> Problem | None:
        """Return that another node publishes a flow; None if none does."""
        return second_publisher(self._own_flow, "two_pumps")


main = live_command(PumpNode, partial(
    node_help, "live.pump", "pump", f"{__doc__}\n{pump_behaviour.__doc__}", parameters,
    "--ros-args -p drive:=danfoss_fc202 -p address:=gateway://127.0.0.1:5020 -p autostart:=true",
    live=True,
))


if __name__ == "__main__":
    main()
