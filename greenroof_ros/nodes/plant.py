"""The plant node, which simulates the cistern and the roof, and sets the pace of the graph.

In tick k, the node publishes ``/clock`` and the levels, and waits for the weather, the command and,
with an external pump, the flow. Then the node integrates the exact model over one tick, and
publishes the clock and the levels of tick k + 1, followed by the flows of tick k.
"""

from __future__ import annotations

from greenroof_ros.base.interrupts import begin_program

begin_program(__name__)

import math
import secrets
import time
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

from greenroof_ros.base.errors import LockstepError, OccupiedError
from greenroof_ros.base.parameter import Parameter
from greenroof_ros.base.times import DEFAULT_START, epoch_ns, read_start
from greenroof_ros.interface.states import PLANT
from greenroof_ros.physics.parameters import Flows
from greenroof_ros.physics.pump import PARAMETERS, SensorAndPump
from greenroof_ros.physics.start import check_volumes, initial_states
from greenroof_ros.physics.storm_water import WITHOUT_RAIN
from greenroof_ros.physics.tick import OWN_PUMPS
from greenroof_ros.physics.virtual_site import VirtualSite
from greenroof_ros.results.metrics import Metrics
from greenroof_ros.ros.lockstep import CLOCK, RUN, LockstepNode
from greenroof_ros.ros.messages import decoder
from greenroof_ros.ros.parameters import declare, site_file
from greenroof_ros.ros.spin import STEADY, node_command
from greenroof_ros.site.site import Site

# How far the plant may be ahead of the ticks that the recorder has flushed (ticks).
_AHEAD = 32
# The longest time to wait for the other nodes to appear, which takes seconds on a busy machine (s).
_START_LIMIT_S = 30.0


def parameters(site: Site) -> list[Parameter]:
    """Return the node's parameters."""
    cistern, roof = next(iter(initial_states(site).values()))
    return [
        site_file(),
        Parameter(
            "initial_cistern_volume", cistern, "m3", 0, 1e9, "water in the cistern at tick 0",
        ),
        Parameter(
            "initial_roof_volume", roof, "m3", 0, 1e9, "water on the roof at tick 0",
        ),
        Parameter(
            "start", DEFAULT_START, meaning="time of tick 0 (ISO 8601, with UTC offset)",
        ),
        Parameter("run_length", site.N, "ticks", 1, 2**40, "number N of the last tick"),
        Parameter(
            "speed", 0.0, "", 0, 1e9, "simulated time divided by wall time; 0 for as fast as "
            "possible",
        ),
        Parameter(
            "pump", "internal", meaning="source of /pump/flow: the plant, or an external driver",
            among=("internal", "external"),
        ),
        *PARAMETERS.values(),
        WITHOUT_RAIN,
        Parameter(
            "record", False,
            meaning="whether to wait for the recorder at the start and during the run",
        ),
        Parameter(
            "peer_limit", 5.0, "", 2, 1e6, "longest time to wait for another node (s of wall time)",
        ),
    ]


class PlantNode(LockstepNode):
    """Node that simulates the plant and paces the ticks."""

    def __init__(self) -> None:
        """Declare the parameters and open the topics."""
        super().__init__("plant", PLANT)
        site = self.declare_site()
        values = declare(self, parameters(site))
        volumes = values["initial_cistern_volume"], values["initial_roof_volume"]
        check_volumes(site, *volumes)
        self._run_length, self._limit = values["run_length"], values["peer_limit"]
        # The wall time of a tick (s); 0 for as fast as possible.
        self._tick_s = site.tau / values["speed"] if values["speed"] else 0.0
        self._external = values["pump"] == "external"
        sensor_and_pump = SensorAndPump(**{name: values[name] for name in PARAMETERS})
        start_ns = epoch_ns(read_start(values["start"]))
        self._site = VirtualSite(
            site, *volumes, start_ns, sensor_and_pump, self._run_length + 1
        )
        self._metrics = Metrics(
            site, self._run_length, start_ns / 1e9, values[WITHOUT_RAIN.name]
        )
        self._published: dict[str, float] = {}  # the last published tick, and its levels (m)
        # How many ticks the recorder has flushed; without a recorder, it does not matter.
        self._written: float = 0 if values["record"] else math.inf
        self._paused = True  # the tick waits for the start, for the pace or for the recorder
        self._pace = self.create_timer(1.0, self._publish_if_due, clock=STEADY)
        self._pace.cancel()
        self._began = self._waiting_since = time.monotonic()

        self.open_outputs(
            CLOCK, "/cistern/level", "/roof/level", "/cistern/outflow", "/roof/drainage", RUN
        )
        self._rain = self.subscribe("/weather/precipitation")
        self._evapotranspiration = self.subscribe("/weather/evapotranspiration")
        # Frost cuts a minimum on-time short, and can close the outlet valve. Otherwise the pump
        # only follows the command.
        needs_frost = sensor_and_pump.pump_min_on or site.valve_closed_in_frost
        self._frost = self.subscribe("/weather/frost") if needs_frost else None
        self._command = self.subscribe("/pump/command")
        self._outlet = self.subscribe("/outlet/command") if site.low_outlet_valve else None
        if self._outlet is not None:
            self.open_outputs("/outlet/flow")
        self._other = None
        if site.monthly_other_demand is not None:
            self._other = self.subscribe("/cistern/other_demand")
            self.open_outputs("/cistern/other_flow")
        if self._external:
            self._flow = self.subscribe("/pump/flow")
        else:
            self.open_outputs("/pump/flow")
        if values["record"]:
            decode = decoder(self.interface["/recorder/written"].type)
            self.open("/recorder/written", lambda message: self._on_written(decode(message)))
        identity = float(secrets.randbits(53))  # a double holds it exactly
        self.publish(RUN, array("d", [identity, self._run_length, values["speed"]]))

    # --- the ticks ----------------------------------------------------------------------------

    def _publish_tick(self) -> None:
        site = self._site
        now = site.time_ns
        self.publish(CLOCK, now)
        cistern, roof = site.observe()
        self._published = {"tick": site.tick, "cistern_level": cistern, "roof_level": roof}
        self.publish("/cistern/level", cistern)
        self.publish("/roof/level", roof)
        self._paused = False
        self._waiting_since = time.monotonic()
        self.time_ns = now

    def on_inputs(self) -> None:
        """Compute the next tick of the plant from the inputs of this tick."""
        site = self._site
        if self._paused:
            raise OccupiedError(
                f"answers to tick {site.tick} arrived before the tick was published: nodes of an "
                "earlier run are still in this graph; stop them"
            )
        if site.tick == 0:
            self._began = time.monotonic()  # before this, the other nodes were still joining
        if self._frost is not None:
            site.frost = self._frost.value if self._frost.good else math.nan
        rain, evapotranspiration = self._rain.value, self._evapotranspiration.value
        command = self._command.value
        flows = site.act(
            rain, evapotranspiration, command,
            self._flow.value if self._external else OWN_PUMPS,
            1.0 if self._outlet is None else self._outlet.value,
            0.0 if self._other is None else self._other.value,
        )
        self._paused = True
        self._waiting_since = time.monotonic()
        if site.tick == self._run_length:
            self._publish_flows(flows)
            self.finish()
            return
        known_rain = rain if self._rain.good else math.nan  # unknown rain counts as wet weather
        self._metrics.add(site.state, command, known_rain, evapotranspiration, flows)
        site.step()
        # Publish the next tick first, if allowed: the other nodes begin it while this node still
        # publishes the flows of the last tick. The order within a topic does not change.
        self._publish_if_due()
        self._publish_flows(flows)

    def _publish_flows(self, flows: Flows) -> None:
        self.publish("/cistern/outflow", flows.outflow)
        self.publish("/roof/drainage", flows.drainage)
        if self._outlet is not None:
            self.publish("/outlet/flow", flows.low_outlet)
        if self._other is not None:
            self.publish("/cistern/other_flow", flows.other)
        if not self._external:
            self.publish("/pump/flow", flows.pump)

    # --- the pace -----------------------------------------------------------------------------

    @property
    def _is_behind(self) -> bool:
        """Whether the recorder's lag has reached its limit."""
        return self._site.tick >= self._written + _AHEAD

    def _publish_if_due(self) -> None:
        """Publish the waiting tick if it is due and the recorder is not too far behind."""
        if self._is_behind:
            return
        if self._tick_s:
            self._pace.cancel()
            wait = self._began + self._site.tick * self._tick_s - time.monotonic()
            if wait > 0:
                self._pace.timer_period_ns = math.ceil(1e9 * wait)
                self._pace.reset()
                return
            if wait < -1.0:  # a pump's minimum times must not pass faster than in reality
                self._began -= wait
        self._publish_tick()

    def _on_written(self, ticks: float) -> None:
        self._written = ticks
        if self.acted and self._paused and not self.finished:
            self._publish_if_due()

    def all_arrived(self) -> bool:
        """Return True if all messages have reached their readers and are flushed to the bag."""
        return self._written > self._run_length and super().all_arrived()

    def on_timer(self, now: float) -> None:
        """Start the run once all nodes are present, and check timeouts.

        Raises:
            LockstepError: if a node is missing or does not respond in time.
        """
        if self.finished and self._written > self._run_length:
            return
        limit = self.limit()
        is_late = now - self._waiting_since > limit
        if self._paused and not self.acted:
            if not (absent := self.absent()):
                self._publish_tick()
            elif is_late:
                raise LockstepError(
                    f"the run did not start within {limit:g} s: {_describe(absent)}"
                )
            return
        waits_for_time = self._paused and not (self.finished or self._is_behind)
        if waits_for_time or not is_late:
            return
        missing = "/recorder/written from recorder"
        if not self._paused:
            # In the order of the inputs, each node waits for the nodes before it.
            silent = self.by_role(name for name in self.inputs if name in self.awaited)
            missing = _describe(dict([*silent.items()][:1]))
        raise LockstepError(f"tick {self._site.tick}: no message within {limit:g} s on {missing}")

    def limit(self) -> float:
        """Return the current maximum wait for another node (s of wall time)."""
        # Nodes that have not answered yet may still be joining.
        answered = self._site.tick and (self._written or not self._paused)
        return self._limit if answered else max(self._limit, _START_LIMIT_S)

    # --- reports ------------------------------------------------------------------------------

    def progress(self) -> dict[str, Any]:
        """Return the tick, the levels (m) and the command.

        The values are from the tick that was published last, whose time is the time stamp of the
        report. The next tick may already be computed and waiting to be due.
        """
        return {**self._published, "command": self._command.value}

    def summary(self) -> dict[str, Any]:
        """Return the metrics, events and duration (s of wall time) of the run."""
        wall_s = time.monotonic() - self._began
        return {**self._metrics.results(self._site.state)._asdict(), "wall_s": wall_s}


def _describe(missing: Mapping[str, Sequence[str]]) -> str:
    """Return a text that lists missing topics, and the roles that should publish them."""
    return "; ".join(f"{', '.join(names)} from {role}" for role, names in missing.items())


main = node_command(PlantNode, __doc__)


if __name__ == "__main__":
    main()
