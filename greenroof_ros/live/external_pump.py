"""The node that guards your own pump driver on a live site, in place of the pump node.

Your driver subscribes to /pump/command and publishes /pump/flow, at least once a second. This node
keeps holds and faults in the state file, and judges the driver by its flow. /pump/hold, which is
published once a second and when it changes, is 1 while the pump must stay off. A controller node of
this package then commands 0, and also if /pump/hold is not arriving. If the driver offers
``~/stop`` (std_srvs/SetBool), this node calls it with true at the beginning of a hold or a fault,
and with false at its end.

:mod:`greenroof_ros.live.actuator` describes the services of this node: ``~/stop``, ``~/release``,
``~/hold``, ``~/clear`` and ``~/reset``.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math

from rclpy.client import Client
from std_srvs.srv import SetBool

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.actuator import COMMAND, FLOW, STATE, STATE_FILE, ActuatorNode
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.levels import live_parameters
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.input_rules import AWAITED
from greenroof_ros.live.pumping.interlocks import Decision, Following, evaluate, state_of
from greenroof_ros.live.pumping.limits import pump_parameters
from greenroof_ros.live.pumping.pump_control import AFTERFLOW_S
from greenroof_ros.live.pumping.state_file import GUARD
from greenroof_ros.physics.pump import RUNNING_SHARE, maximum_pump_flow
from greenroof_ros.ros.parameters import site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

_HOLD = "/pump/hold"
# The longest time between two messages on /pump/hold (s).
_HOLD_S = 1.0


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters, among them settings that also apply to your driver."""
    settings = {setting.name: setting for setting in pump_parameters(site)}
    return [
        site_file(), STATE_FILE, settings["min_flow"], settings["follow_time"],
        *live_parameters([COMMAND, FLOW]),
    ]


class ExternalPumpNode(ActuatorNode):
    """Node that judges a pump driver of another program, and tells it to stay off."""

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter is invalid.
        """
        super().__init__(GUARD, parameters)
        self._max_flow = maximum_pump_flow(self.site, self.site.cistern_volume(self.site.z_o))
        self._hold_sent, self._sent_at = 0.0, -math.inf
        self._driver: Client | None = None  # the driver's own service to stop it
        self._told = False  # whether the driver was last told to stop
        self._lost = False  # whether the driver was lost at the last step
        self._command, self._flow = self.subscribe(COMMAND), self.subscribe(FLOW)
        self.open_outputs(_HOLD, STATE)
        self.discard_evidence()

    def discard_evidence(self, checked: bool = False) -> None:
        """Forget what led to a fault."""
        self._stopping = Following(self.values["min_flow"])

    def switch_off(self) -> str:
        """Return why a hold does not stop the pump: nobody who could stop it reads /pump/hold."""
        readers = {info.node_name for info in self.get_subscriptions_info_by_topic(
            self.resolve_topic_name(self.interface[_HOLD].graph_name)
        )}
        names = [*self._command.publishers.names(), *self._flow.publishers.names()]
        offers_stop = self._driver is not None and self._driver.service_is_ready()
        if offers_stop or readers & set(names):
            return ""
        return (
            "this cannot stop the pump, since neither your controller nor your pump driver reads "
            f"{_HOLD}, and the driver does not offer ~/stop: stop the pump yourself"
        )

    def step(self, dt: float) -> Decision:
        """Judge the driver, and publish the hold."""
        lost = self._driver_problem()
        alive = self._flow.good and self._flow.publishers.compatible
        flow = float(self._flow.value) if alive else None
        share = None if flow is None else flow / self._max_flow
        command = float(self._command.value) if self._command.good else 0.0
        reasons = [lost] if lost else []
        if share is not None and (command == 0 or self._hold_sent):
            self._stopping.update(min(dt, PAUSE_S), share, 0.0)
            if self._stopping.error_for > self.values["follow_time"] + AFTERFLOW_S:
                reasons.append(Diagnosis.of(
                    "runs_on", "driver", flow=flow or 0.0, time=self._stopping.error_for
                ))
        else:
            self.discard_evidence()
        active = evaluate(self.state_file, reasons)
        hold, now = float(bool(active)), boot_time()
        if hold != self._hold_sent or now - self._sent_at >= _HOLD_S:
            self._hold_sent, self._sent_at = hold, now
            self.publish(_HOLD, hold)
        stop = bool(active.keys() - {"driver_lost", "two_pumps"})
        if self._lost and lost is None and stop:
            self._told = False  # it may have been started again
        self._lost = lost is not None
        self._tell_driver(stop)
        runs = share is not None and share > RUNNING_SHARE
        state = "running" if runs else "off"
        why = f"the command is {command:g}" if self._command.good else "no valid command arrives"
        if active:
            state, why = state_of(active)
        reported = f"your own pump driver reports {'a' if runs else 'no'} flow"
        if flow is None:
            state = "unknown" if state == "off" else state
            reported = "it is unknown whether the pump has stopped"
        self.reports.diagnose("driver", lost, "your own pump driver is responding")
        at_rest = share is not None and not runs
        return Decision(active, state, f"{why}; {reported}", at_rest, share, flow)

    def _driver_problem(self) -> Diagnosis | None:
        publishers = self._flow.publishers
        if second := publishers.describe_second():
            return Diagnosis.of("two_pumps", topic=publishers.full_name, problem=second)
        if not publishers.compatible:
            return Diagnosis.of("driver_lost", "lease", topic=publishers.full_name)
        if (why := self._flow.diagnosis) is not None:
            case = "awaited" if why.code in AWAITED else "age"
            return Diagnosis.of("driver_lost", case, why=why.sentence)
        return None

    def _tell_driver(self, stop: bool) -> None:
        """Call the driver's ``~/stop``, if it offers one, when a hold or a fault begins or ends."""
        if self._driver is None:
            offered = dict(self.get_service_names_and_types())
            for info in self.get_publishers_info_by_topic(self._flow.publishers.full_name):
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}/stop"
                if "std_srvs/srv/SetBool" in offered.get(name, ()):
                    self._driver = self.create_client(SetBool, name)
        if self._driver is not None and stop != self._told and self._driver.service_is_ready():
            self._told = stop
            self._driver.call_async(SetBool.Request(data=stop))


main = live_command(ExternalPumpNode, __doc__)


if __name__ == "__main__":
    main()
