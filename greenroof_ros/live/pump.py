"""The pump node of a live site.

It acts every tau of the site, on the newest values, and lets the pump run only on fresh, good ones.
:mod:`greenroof_ros.live.pump_behaviour` describes what it does, and its services.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import boot_time
from greenroof_ros.graph.parameters import declare
from greenroof_ros.live import pump_behaviour
from greenroof_ros.live.engine import Levels, live_parameters
from greenroof_ros.live.lifecycle import Lifecycle
from greenroof_ros.live.node import LiveNode, live_command, live_help
from greenroof_ros.live.pump_behaviour import COMMAND_LIMIT, PumpBehaviour, common_parameters
from greenroof_ros.live.pumping.pump_inputs import INPUTS
from greenroof_ros.model.site import Site


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [*common_parameters(site), *live_parameters(row.topic for row in INPUTS)]


class PumpNode(Lifecycle, LiveNode):
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
        command = self.subscribe("/pump/command", lambda _: self._pump.command_received())
        self._levels = Levels(site, values, self.subscribe)
        inputs = {
            "command": command, "cistern_level": self._levels.cistern,
            "roof_level": self._levels.roof,
        }
        inputs |= {
            row.name: self.subscribe(row.topic, optional=not row.unknown)
            for row in INPUTS if row.name not in inputs
        }
        self._pump = PumpBehaviour(
            self, site, values, inputs, command.publishers, clock=boot_time,
            displacements=lambda: self._levels.displacements,
            own_flow=self.subscribe("/pump/flow", optional=True).publishers,
        )
        Lifecycle.__init__(self, self._pump)

    def on_inputs(self) -> None:
        """Decide, and publish the flow."""
        flow = self._pump.step(boot_time()).flow
        if self._levels.cistern.good and self._levels.roof.good:
            self._levels.expect(flow)
        self.publish("/pump/flow", flow)

    def on_timer(self, now: float) -> None:
        """Check the pump."""
        self._pump.check()

    def on_stop(self) -> None:
        """Stop the pump."""
        self._pump.stop()

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        return self._pump.progress()


main = live_command(PumpNode, partial(
    live_help, "live.pump", "pump", f"{__doc__}\n{pump_behaviour.__doc__}", parameters,
    "--ros-args -p drive:=danfoss_fc202 -p address:=gateway://127.0.0.1:5020 -p autostart:=true",
))


if __name__ == "__main__":
    main()
