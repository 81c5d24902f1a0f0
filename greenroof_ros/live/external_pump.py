"""The node that guards your own pump driver on a live site, in place of the pump node.

Your driver subscribes to /pump/command and publishes /pump/flow, at least once a second. This node
keeps holds and faults in the state file, and judges the driver by its flow. /pump/hold, which is
published once a second and when it changes, is 1 while the pump must stay off. A controller node of
this package then commands 0, and also if /pump/hold is not arriving. If the driver offers
``~/stop`` (std_srvs/SetBool), this node calls it with true at the beginning of a hold or a fault,
with false at its end, and with either when a driver appears.

:mod:`greenroof_ros.live.actuator` describes the services of this node: ``~/stop``, ``~/release``,
``~/hold``, ``~/clear`` and ``~/reset``.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math

from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import SetBool

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import boot_time
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import PUMP
from greenroof_ros.live.actuator import COMMAND, FLOW, STATE_FILE, ActuatorNode
from greenroof_ros.live.live_input import live_parameters
from greenroof_ros.live.node import live_command
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
# A driver that delivers a smaller share of what is commanded does not pump.
_IDLE = 0.1
# The conditions of a driver that is not there or not alone, which do not stop it.
_ABSENT = {"driver_lost", "two_pumps"}


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
        super().__init__(GUARD, PUMP, parameters)
        self._max_flow = maximum_pump_flow(self.site, self.site.cistern_volume(self.site.z_o))
        self._hold_sent, self._sent_at = 0.0, -math.inf
        self._stops: dict[str, Client] = {}  # the drivers' own services to stop them, by name
        # What each was told since a driver appeared, and its answer.
        self._told: dict[str, tuple[bool, Future]] = {}
        self._idle_for = 0.0  # for how long it has not been pumping as commanded (s)
        self._command, self._flow = self.subscribe(COMMAND), self.subscribe(FLOW)
        self.open_outputs(_HOLD)
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
        offers_stop = any(client.service_is_ready() for client in self._stops.values())
        if offers_stop or readers & set(names):
            return ""
        return (
            "this cannot stop the pump, since neither your controller nor your pump driver reads "
            f"{_HOLD}, and the driver does not offer ~/stop: stop the pump yourself"
        )

    def step(self, dt: float) -> Decision:
        """Judge the driver, and publish the hold."""
        lost = self._driver_problem()
        flow = None if lost else float(self._flow.value)
        share = None if flow is None else flow / self._max_flow
        command = float(self._command.value) if self._command.good else 0.0
        reasons, idle = [lost] if lost else [], None
        wanted, passed = 0.0 if self._hold_sent else command, min(dt, PAUSE_S)
        limit, least = self.values["follow_time"] + AFTERFLOW_S, self.values["min_flow"]
        if share is not None and wanted == 0:
            self._stopping.update(passed, share, 0.0)
            if self._stopping.error_for > limit:
                reasons.append(Diagnosis.of(
                    "runs_on", "driver", flow=flow or 0.0, time=self._stopping.error_for
                ))
        else:
            self.discard_evidence()
        is_idle = share is not None and wanted >= least and share < _IDLE * wanted
        self._idle_for = self._idle_for + passed if is_idle else 0.0
        if self._idle_for > limit:
            idle = Diagnosis.of("driver_idle", command=wanted, time=self._idle_for)
        active = evaluate(self.state_file, reasons)
        if not lost and _ABSENT & self.decision.active.keys():  # another one, or started again
            self._told.clear()
        hold, now = float(bool(active)), boot_time()
        if hold != self._hold_sent or now - self._sent_at >= _HOLD_S:
            self._hold_sent, self._sent_at = hold, now
            self.publish(_HOLD, hold)
            self._tell_drivers(bool(active.keys() - _ABSENT))
        runs = share is not None and share > RUNNING_SHARE
        state = "running" if runs else "off"
        why = f"the command is {command:g}" if self._command.good else "no valid command arrives"
        if active:
            state, why = state_of(active)
        reported = f"your own pump driver reports {'a' if runs else 'no'} flow"
        if flow is None:
            state = "unknown" if state == "off" else state
            reported = "it is unknown whether the pump has stopped"
        self.reports.diagnose("driver", lost or idle, "your own pump driver is responding")
        at_rest = share is not None and not runs
        return Decision(active, state, f"{why}; {reported}", at_rest, share, flow)

    def _driver_problem(self) -> Diagnosis | None:
        publishers = self._flow.publishers
        if conflict := publishers.describe_conflict():
            return Diagnosis.of("two_pumps", topic=publishers.full_name, problem=conflict)
        why = str(self._flow.diagnosis or "")
        if not publishers.compatible:
            why = f"{publishers.full_name} has no live publisher"
        return Diagnosis.if_any("driver_lost", why)

    def _tell_drivers(self, stop: bool) -> None:
        """Call ``~/stop`` of every driver that offers it, until it has answered."""
        offered = dict(self.get_service_names_and_types())
        for info in self.get_publishers_info_by_topic(self._flow.publishers.full_name):
            name = f"{info.node_namespace.rstrip('/')}/{info.node_name}/stop"
            if name not in self._stops and "std_srvs/srv/SetBool" in offered.get(name, ()):
                self._stops[name] = self.create_client(SetBool, name)
        for name, client in self._stops.items():
            told, answer = self._told.get(name, (None, Future()))
            if client.service_is_ready() and not (told == stop and answer.done()):
                client.remove_pending_request(answer)
                self._told[name] = stop, client.call_async(SetBool.Request(data=stop))


main = live_command(ExternalPumpNode, __doc__)


if __name__ == "__main__":
    main()
