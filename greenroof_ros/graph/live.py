"""A live graph: a node acts every tick of the steady clock, on the newest value of each input.

There is no plant and no clock topic. What is missing, late or wrong is not waited for: the node is
told which of its inputs are not good, by the rules of
:mod:`greenroof_ros.pumping.input_rules`, and acts accordingly.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from rclpy.node import Node

from greenroof_ros.common.clock import boot_time, suspended_time
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.graph.errors import LockstepError
from greenroof_ros.graph.inputs import Inputs
from greenroof_ros.graph.peers import Peers
from greenroof_ros.graph.publishers import Publishers
from greenroof_ros.graph.reports import ERROR, OK, WARN, Report
from greenroof_ros.graph.validation import Input
from greenroof_ros.pumping.input_rules import InputRules, LevelRule, Verdict

# A pause of this process itself (s): what it has then is of before. For so long after it, too, what
# comes may have waited.
_PAUSE_S = 1.0

RECOVERY = Parameter(
    "recovery_time", 10.0, "s", 0.0, 86400.0, "live: for how long an input that was not good "
    "must be good again",
)
FROZEN_MOVEMENT = Parameter(
    "frozen_movement", 0.01, "", 1e-6, 10.0, "live: a level that shows no change while pump and "
    "rain must have moved it by so much is frozen (m); above the sensor's resolution",
)
JUMP_TOLERANCE = Parameter(
    "jump_tolerance", 0.02, "", 1e-6, 10.0, "live: how far two values of a level may be apart "
    "beyond what water can do between them (m); at least 10 times the sensor's noise (standard "
    "deviation)",
)
LEVEL_PARAMETERS = [FROZEN_MOVEMENT, JUMP_TOLERANCE]


def _limit(name: str, default: float, most: float, what: str) -> Parameter:
    return Parameter(name, default, "s", 0.1, most, f"live: greatest age of {what}")


_LEVEL = _limit("level_limit", 5.0, 60.0, "a level")
_FORECAST = _limit("forecast_limit", 3600.0, 86400.0, "a forecast, since it came")
_FROST = _limit("frost_limit", 60.0, 600.0, "frost")
_GAUGE = _limit("gauge_limit", 60.0, 3600.0, "what the gauges measure")
_FLOW = _limit("flow_limit", 5.0, 60.0, "the pump's flow")
# Of each topic that somebody acts on in a live graph, how old it may be.
LIMITS = {
    "/cistern/level": _LEVEL,
    "/roof/level": _LEVEL,
    "/forecast/precipitation": _FORECAST,
    "/forecast/evapotranspiration": _FORECAST,
    "/weather/frost": _FROST,
    "/gauge/precipitation": _GAUGE,
    "/gauge/temperature": _GAUGE,
    "/pump/command": _limit("command_limit", 3.0, 10.0, "a command; more than tau"),
    "/pump/flow": _FLOW,
    "/pump/meter": _FLOW,
}


def live_parameters(topics: Iterable[str]) -> list[Parameter]:
    """Return the parameters of a node that acts on some topics in a live graph, but ``live``."""
    return [*dict.fromkeys(LIMITS[topic] for topic in topics), RECOVERY]


class LiveNode(Protocol):
    """What a live graph needs of its node; see :class:`greenroof_ros.graph.link.LinkedNode`."""

    acted: bool
    inputs: Inputs

    def on_inputs(self) -> None:
        """Act."""

    def diagnose(self, part: str, level: bytes, message: str, code: str = "") -> None:
        """Say how a part of the node is."""


class _LiveInput:
    """An input with its rules and publishers."""

    def __init__(self, entry: Input, rules: InputRules, publishers: Publishers) -> None:
        self.entry = entry
        self.rules = rules
        self.publishers = publishers
        self.verdict = Verdict()
        self.judge(boot_time())
        publishers.on_change = lambda: self.judge(boot_time())

    def judge(self, now: float) -> None:
        """Judge the input as it is now (s since the machine started), and show at it how it is."""
        self.verdict = self.rules.judge(now, self.publishers.problem(time.monotonic()))
        self.entry.good = self.verdict.good
        self.entry.why = self.verdict.why
        self.entry.code = self.verdict.code


class Live:
    """Makes a node act every period of the steady clock; a peer's end is not its own.

    That clock goes on while the machine is suspended: what came before is then too old.

    Attributes:
        simulated_time: whether the node's clock is that of a run; here it is the system's.
        peers: the other nodes, as they report.
    """

    simulated_time = False

    def __init__(self, node: LiveNode, ros_node: Node) -> None:
        """Begin without a period.

        Args:
            node: that is to act.
            ros_node: the same, as rclpy has it.
        """
        self.peers = Peers()
        self._node = node
        self._ros_node = ros_node
        self._period = math.inf
        self._due = math.inf
        self._inputs: dict[str, _LiveInput] = {}
        self._needed: list[_LiveInput] = []
        self._looked = boot_time()
        self._deaf_until = self._looked

    def act_every(self, period: float) -> None:
        """Let the node act from now on every period (s)."""
        self._period = period
        self._due = boot_time() + period

    def open(
        self, entry: Input, callback: Callable[[Any], None] | None, *, raw: bool,
        optional: bool, level: LevelRule | None, **rules_of_lockstep: object,
    ) -> tuple[Publishers, Callable[[bytes], None]]:
        """Prepare an input; see :meth:`greenroof_ros.graph.link.LinkedNode.subscribe`."""
        node = self._ros_node
        publishers = Publishers(node, entry.topic, self.peers)
        limit = LIMITS[entry.topic.name].name
        rules = InputRules(
            boot_time(), node.get_parameter(limit).value,
            node.get_parameter(RECOVERY.name).value, limit_name=limit, level=level,
        )
        self._inputs[entry.topic.name] = one = _LiveInput(entry, rules, publishers)
        if not optional:
            self._needed.append(one)

        def on_message(message: bytes) -> None:
            now = boot_time()
            self._note_pause(now)
            if now < self._deaf_until:
                return
            entry.good = entry.heard = True
            try:
                entry.receive(message)
            except (LockstepError, ValueError, struct.error) as error:
                entry.refused += 1
                entry.good = False
                entry.why = f"was refused: {error}"
            rules.came(now, entry.value, "" if entry.good else entry.why)
            one.judge(now)
            if callback is not None:
                callback(entry.value)

        return publishers, on_message

    def refuse(self, name: str, why: str) -> None:
        """Refuse the newest value of an input: who acts on it cannot."""
        one = self._inputs[name]
        one.entry.refused += 1
        now = boot_time()
        one.rules.refuse(now, f"was refused: {why}")
        one.judge(now)
        self._say()

    def good(self) -> bool:
        """Whether all that the node needs is good now."""
        now = boot_time()
        for one in self._inputs.values():
            one.judge(now)
        return all(one.entry.good for one in self._needed)

    def due_in(self) -> float:
        """How long until the node acts (s)."""
        return max(0.0, self._due - boot_time())

    def act_if_due(self) -> None:
        """Act once in a period; of periods that were missed, by a pause, none is made good."""
        now = boot_time()
        if now < self._due:
            return
        self._note_pause(now)
        self._due += (math.floor((now - self._due) / self._period) + 1) * self._period
        self._node.acted = True
        before = suspended_time()
        self.good()
        self._say()
        self._node.on_inputs()
        # What a node takes to decide is no pause: what it decides on must not be too old then. A
        # suspend in the middle of it is one.
        slept = suspended_time() - before
        self._looked = boot_time() - slept

    def look(self, now: float) -> None:
        """Look whether the process was stopped, or the machine suspended."""
        self._note_pause(boot_time())

    def hear(self, report: Report) -> None:
        """Take a peer's report."""
        self.peers.hear(report)

    def _note_pause(self, now: float) -> None:
        """Forget all inputs if the process itself stood still."""
        passed, self._looked = now - self._looked, now
        if passed > _PAUSE_S:
            self._deaf_until = now + _PAUSE_S
            for one in self._inputs.values():
                one.rules.paused(now, passed)
                one.judge(now)

    def _say(self) -> None:
        """Say which of the inputs that the node needs are not good, and why."""
        bad = [one for one in self._needed if not one.verdict.good]
        if not bad:
            if self._needed:
                self._node.diagnose("inputs", OK, "all inputs are good")
            return
        alarming = [one for one in bad if one.verdict.alarming]
        self._node.diagnose(
            "inputs", ERROR if alarming else WARN,
            "; ".join(f"{one.entry.name} {one.verdict.why}" for one in bad),
            (alarming or bad)[0].verdict.code,
        )
