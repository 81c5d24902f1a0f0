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

from greenroof_ros.ros import begin_node

begin_node(__name__)

import math
from collections.abc import Iterator
from typing import Any

from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import SetBool

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.interface.states import DriveState, PumpState
from greenroof_ros.live.actuator import STATE_FILE, ActuatorNode
from greenroof_ros.live.boot_clock import boot_time
from greenroof_ros.live.levels import LIMITS, live_parameters
from greenroof_ros.live.live_diagnostics import ERROR, OK, WARN
from greenroof_ros.live.node import live_command
from greenroof_ros.live.pumping.input_rules import AWAITED
from greenroof_ros.live.pumping.interlocks import evaluate, latch, state_of, stored_reasons
from greenroof_ros.live.pumping.limits import check_command_limit, pump_parameters
from greenroof_ros.live.pumping.state_file import GUARD
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.ros.reports import PAUSE_S
from greenroof_ros.site.site import Site

_COMMAND, _FLOW, _HOLD = "/pump/command", "/pump/flow", "/pump/hold"
# Interval between two decisions, and the longest between two messages on /pump/hold (s).
_STEP_S, _HOLD_S = 0.1, 1.0
# A flow up to this share of the maximum flow counts as none.
_NONE = 0.01
# The settings of the pump that also apply to a driver of another program.
_SETTINGS = ("min_flow", "drive_ramp", "follow_time")


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    return [
        site_file(), STATE_FILE,
        *(setting for setting in pump_parameters(site) if setting.name in _SETTINGS),
        *live_parameters([_COMMAND, _FLOW]),
    ]


class ExternalPumpNode(ActuatorNode):
    """Node that judges a pump driver of another program, and tells it to stay off."""

    def __init__(self) -> None:
        """Declare the parameters, and open the topics and services.

        Raises:
            ConfigurationError: if a parameter is invalid.
        """
        super().__init__(GUARD)
        site = self.declare_site()
        values = declare(self, parameters(site))
        limit = LIMITS[_COMMAND].name
        check_command_limit(values[limit], site.tau, f"parameter {limit} of {self.get_name()}")
        self._max_flow = maximum_pump_flow(site, site.cistern_volume(site.z_o))
        self._min_flow = values["min_flow"] * self._max_flow
        # For how long the pump may deliver water after it had to stop (s).
        self._stops_within = values["drive_ramp"] + values["follow_time"]
        self._flowed_for = 0.0
        self._pump, self._hold_sent, self._sent_at = PumpState(), 0.0, -math.inf
        self._driver: Client | None = None  # the driver's own service to stop it
        self._told: tuple[str, ...] = ()  # why the driver was last told to stop
        self._stepped = boot_time()
        self._command = self.subscribe(_COMMAND)
        self._flow = self.subscribe(_FLOW)
        self.open_outputs(_HOLD, "/pump/state")
        self.open_state_file(values[STATE_FILE.name], site.zone)

    def discard_evidence(self) -> None:
        """Forget what led to a fault."""
        self._flowed_for = 0.0

    def out_of_reach(self) -> str:
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

    def on_timer(self, now: float) -> None:
        """Decide, and report."""
        if boot_time() - self._stepped >= _STEP_S:
            self.check_state_file()
            self.decide()

    def decide(self) -> PumpState:
        """Judge the driver, publish the hold, and return the state of the pump."""
        now = boot_time()
        dt, self._stepped = min(now - self._stepped, PAUSE_S), now
        self.check_inputs()
        flow = self._known_flow()
        command = float(self._command.value) if self._command.good else 0.0
        must_stop = command == 0 or bool(self._hold_sent)
        runs_on = must_stop and flow is not None and flow > self._min_flow
        self._flowed_for = self._flowed_for + dt if runs_on else 0.0
        faults = []
        if flow is not None and self._flowed_for > self._stops_within:
            faults.append(Diagnosis.of("runs_on", "driver", flow=flow, time=self._flowed_for))
        latch(self.state_file, faults)
        driver = [*self._driver_reasons()]
        stored = stored_reasons(self.state_file)
        active = evaluate([*faults, *stored, *driver])
        self._send_hold(float(bool(active)), now)
        self._tell_driver(tuple(each.code for each in stored))
        why = "the command is 0" if self._command.good else "no valid command arrives"
        state = "off"
        if active:
            state, why = state_of(active)
        elif flow is not None and flow > _NONE * self._max_flow:
            state, why = "running", "your own pump driver reports a flow"
        elif command:
            why = "your own pump driver reports no flow, although it is commanded to pump"
        if flow is None:
            state = "unknown" if state == "off" else state
            why += "; it is unknown whether the pump has stopped"
        elif active and flow > _NONE * self._max_flow:
            why += f"; your own pump driver still reports {flow:.3g} m3/s"
        pump = PumpState(state, why, tuple(active))
        self._report(pump, active[pump.codes[0]] if active else None, driver)
        if pump != self._pump:
            self._pump = pump
            self.publish("/pump/state", pump.message())
        return pump

    def _known_flow(self) -> float | None:
        """Return the flow that the driver reports (m3/s); None if the driver may be dead."""
        alive = self._flow.good and self._flow.publishers.compatible
        return float(self._flow.value) if alive else None

    def _driver_reasons(self) -> Iterator[Diagnosis]:
        publishers = self._flow.publishers
        if second := publishers.describe_second():
            yield Diagnosis.of("two_pumps", topic=publishers.full_name, problem=second)
        elif not publishers.compatible:
            yield Diagnosis.of("driver_lost", "lease", topic=publishers.full_name)
        elif (why := self._flow.diagnosis) is not None:
            case = "awaited" if why.code in AWAITED else "age"
            yield Diagnosis.of("driver_lost", case, why=why.sentence)

    def _send_hold(self, hold: float, now: float) -> None:
        if hold != self._hold_sent or now - self._sent_at >= _HOLD_S:
            self._hold_sent, self._sent_at = hold, now
            self.publish(_HOLD, hold)

    def _tell_driver(self, why: tuple[str, ...]) -> None:
        """Call the driver's ``~/stop``, if it offers one, when a hold or a fault changes."""
        if self._driver is None:
            offered = dict(self.get_service_names_and_types())
            for info in self.get_publishers_info_by_topic(self._flow.publishers.full_name):
                name = f"{info.node_namespace.rstrip('/')}/{info.node_name}/stop"
                if "std_srvs/srv/SetBool" in offered.get(name, ()):
                    self._driver = self.create_client(SetBool, name)
        if self._driver is not None and why != self._told and self._driver.service_is_ready():
            self._told = why
            self._driver.call_async(SetBool.Request(data=bool(why))).add_done_callback(
                self._check_answer
            )

    def _check_answer(self, answer: Future) -> None:
        """Log that the driver has not done what it was told."""
        if not answer.result().success:
            self.get_logger().error(
                f"your own pump driver rejected a call of ~/stop: {answer.result().message}"
            )

    def _report(
        self, pump: PumpState, first: Diagnosis | None, driver: list[Diagnosis]
    ) -> None:
        diagnose = self.reports.diagnose
        level = OK if first is None else ERROR if pump.state == "fault" else WARN
        diagnose("pump", first and Diagnosis(first.code, str(pump)), str(pump), level, log=False)
        diagnose("driver", driver[0] if driver else None, "your own pump driver is responding")

    def progress(self) -> dict[str, Any]:
        """Return the values that bringup and the page show."""
        flow = self._known_flow()
        trouble = DriveState.CONNECTING if flow is None else None
        return {
            "pump_state": self._pump.state, "pump_why": self._pump.why,
            **({"speed": None} if flow is None else {}),
            "at_rest": flow is not None and flow <= _NONE * self._max_flow,
            "flow": flow,
            "drive_state": self.device_state(trouble).value,
            **super().progress(),
        }


main = live_command(ExternalPumpNode, __doc__)


if __name__ == "__main__":
    main()
