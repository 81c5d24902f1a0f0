"""The pump node of a simulated run with a drive in the loop.

It acts in lockstep with the plant, once command, levels and frost of a tick have arrived, and runs
a drive. :mod:`greenroof_ros.live.pump_behaviour` describes what it does, and its services.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from greenroof_ros.common.conditions import Diagnosis
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.common.times import boot_time
from greenroof_ros.graph.executable import node_command, node_help
from greenroof_ros.graph.lockstep import CLOCK
from greenroof_ros.graph.node import SimulationNode
from greenroof_ros.graph.parameters import declare
from greenroof_ros.live import pump_behaviour
from greenroof_ros.live.devices.drive import real_time_error
from greenroof_ros.live.lifecycle import Lifecycle
from greenroof_ros.live.live_diagnostics import LiveDiagnostics
from greenroof_ros.live.pump_behaviour import COMMAND_LIMIT, PumpBehaviour, common_parameters
from greenroof_ros.live.pumping.pump_inputs import INPUTS
from greenroof_ros.model.site import Site


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [*common_parameters(site), COMMAND_LIMIT]


class LoopPumpNode(Lifecycle, SimulationNode):
    """Runs a drive in place of the simulated pump."""

    reports: LiveDiagnostics

    def __init__(self) -> None:
        """Declare the parameters, and open topics and services.

        Raises:
            ConfigurationError: a parameter, or the drive file, is wrong.
        """
        SimulationNode.__init__(self, "pump", "pump", LiveDiagnostics)
        self._site = self.declare_site()
        values = declare(self, parameters(self._site))
        self._simulated = 0.0  # simulated time (s), counted from 0
        inputs = {
            row.name: self.subscribe(row.topic, tolerates_second=row.name == "command")
            for row in INPUTS if row.unknown  # the simulation has no flow meter
        }
        self.listen(CLOCK, self.set_time)
        self._pump = PumpBehaviour(
            self, self._site, values, inputs, self.peers.publishers["/pump/command"],
            clock=lambda: self._simulated, missing_run=self._missing_run, simulated=True,
        )
        Lifecycle.__init__(self, self._pump)

    def on_inputs(self) -> None:
        """Decide on the inputs of a tick, and publish the flow."""
        self._refuse_other_speed()
        self._pump.command_received()
        self._simulated += self._site.tau
        self.publish("/pump/flow", self._pump.step(boot_time()).flow)

    def on_timer(self, now: float) -> None:
        """Check the speed of the run, and the pump; report a change at once."""
        self._refuse_other_speed()
        self._pump.check()
        if self.reports.urgent:
            self.report_state()

    def on_stop(self) -> None:
        """Stop the pump."""
        self._pump.stop()

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup shows and waits for."""
        return self._pump.progress()

    def _missing_run(self) -> Diagnosis | None:
        """Return why the drive must not run before /run gives the speed; None if it may.

        Levels without a plant are invented and may change at any speed. Only the drive simulator,
        once it is known to be that, may run on them.
        """
        why = self._pump.drive.snapshot.no_simulator
        if self.lockstep.run is not None or why == "":
            return None
        return Diagnosis.of(
            "no_run", why=why or "it is still unknown whether the drive is the drive simulator"
        )

    def _refuse_other_speed(self) -> None:
        """Refuse a run that is not in real time, unless the drive is the drive simulator.

        Raises:
            ConfigurationError: it is another drive.
        """
        run = self.lockstep.run
        if run is not None and run.speed != 1:
            self._pump.drive.require_simulator()
            if why := self._pump.drive.snapshot.no_simulator:
                raise real_time_error(why, "the plant's speed", run.speed)


main = node_command(LoopPumpNode, partial(
    node_help, "live.loop_pump", "pump", f"{__doc__}\n{pump_behaviour.__doc__}", parameters,
    "--ros-args -p drive:=danfoss_fc202 -p address:=gateway://127.0.0.1:5020 -p autostart:=true",
))


if __name__ == "__main__":
    main()
