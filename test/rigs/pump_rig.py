"""The pump's logic with a drive and the plant of the site, in simulated time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from paper import PAPER_SITE

from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.interlocks import Decision
from greenroof_ros.live.pumping.limits import Observation, PumpSettings, pump_parameters
from greenroof_ros.live.pumping.pump_control import PumpControl
from greenroof_ros.live.pumping.state_file import StateFile
from greenroof_ros.physics.parameters import State, plant_parameters
from greenroof_ros.physics.tick import step
from greenroof_ros.site.site import Site

LOST = Diagnosis("drive_lost", "no connection")
NOT_READY = Diagnosis("drive_not_ready")
OVERLOAD = Diagnosis.of("drive_fault", fault="overload")


def settings_for(site: Site, **changes: float) -> PumpSettings:
    """The settings for a site: those given, and defaults for the others."""
    return PumpSettings(**{"min_speed": 0.3} | {
        parameter.name: parameter.default for parameter in pump_parameters(site)
    } | changes)


class Rig:
    """Steps pump control, drive and plant; a test sets the faults.

    Attributes:
        plant: parameters of the true plant.
        x1: true volume in the cistern (m3).
        x2: true volume on the roof (m3).
        speed: of the pump, share of the rated speed.
        change: fields of Observation to override in the next steps.
        arriving: share of the flow that reaches the roof.
        leaving: share of the flow that leaves the cistern.
        leak: other water that leaves the cistern (m3/s).
        stuck_speed: speed of the drive regardless of what is asked for; None if it follows.
        contactor_stuck: whether the pump runs at rated speed while the drive reports a stop.
        cistern_offset: what the cistern's sensor reads above the true level (m).
        delivered: volume pumped according to the decisions (m3).
        decisions: all decisions.
    """

    def __init__(
        self,
        x1: float = 70.0,
        x2: float = 1.0,
        *,
        site: Site = PAPER_SITE,
        settings: PumpSettings | None = None,
        file: Path | None = None,
        noise: float = 0.0,
        drive_ramp: float = 0.2,
        tau: float = 1.0,
    ) -> None:
        self.site = replace(site, tau=tau)
        self.settings = settings or settings_for(self.site)
        self.plant = plant_parameters(self.site)
        self.x1, self.x2, self._layer = x1, x2, self.site.initial_layer
        self.state_file = StateFile(file)
        self.control = PumpControl(self.site, self.settings, self.state_file, 15.0)
        self.tau = tau
        self.now = 1000.0
        self.speed = 0.0
        self.change: dict[str, object] = {}
        self.arriving = self.leaving = 1.0
        self.leak = self.cistern_offset = 0.0
        self.stuck_speed: float | None = None
        self.contactor_stuck = False
        self.delivered = 0.0
        self.decisions: list[Decision] = []
        self._drive_ramp = drive_ramp
        self._noise = self._errors(noise)
        self._dt = 0.0

    def _errors(self, noise: float) -> Iterator[tuple[float, float]]:
        generator = np.random.default_rng(7)
        while True:
            yield from (noise * generator.standard_normal((4096, 2))).tolist()

    def step(
        self, command: float | None, rain: float = 0.0, evapotranspiration: float = 0.0
    ) -> Decision:
        """Advance by a tick; rain in m/s, evapotranspiration from the bed in m3/s."""
        cistern, roof = self.levels()
        errors = next(self._noise)
        observed = Observation(
            command=command, cistern_level=cistern + self.cistern_offset + errors[0],
            roof_level=roof + errors[1], frost=False, time_ns=round(self.now * 1e9),
            speed=self.speed,
        )
        decision = self.control.step(
            self._dt, replace(observed, **self.change)  # type: ignore[arg-type]
        )
        self.decisions.append(decision)
        self.delivered += (decision.flow or 0.0) * self.tau
        setpoint = decision.request or 0.0
        true_flow = self.plant_flow(1.0 if self.contactor_stuck else self.speed)
        pumped = self._advance(true_flow, rain, evapotranspiration)
        self.x1 -= (self.leaving - 1) * pumped * self.tau
        self.x2 += (self.arriving - 1) * pumped * self.tau
        if self.stuck_speed is not None:
            self.speed = self.stuck_speed
        else:
            most = self._drive_ramp * self.tau
            self.speed += min(most, max(-most, setpoint - self.speed))
        self.now += self.tau
        self._dt = self.tau
        return decision

    def clear(self) -> None:
        """Clear the fault, as the node does."""
        self.state_file.change(fault="", fault_code="")
        self.control.discard_evidence()

    def suspend(self, seconds: float, runs_on: float = 0.0) -> Decision:
        """Let time pass without steps of the pump; then the drive's own timeout has stopped it."""
        for second in range(round(seconds / self.tau)):
            if second * self.tau >= runs_on:
                self.speed = 0.0
            self._advance(self.plant_flow(self.speed))
        self.now += seconds
        return self.control.step(seconds, Observation())

    def levels(self) -> tuple[float, float]:
        """Return the true levels of the cistern and the roof (m)."""
        return self.x1 / self.site.a1, self.x2 / self.site.a2

    def _advance(self, flow: float, rain: float = 0.0, evapotranspiration: float = 0.0) -> float:
        """Advance the plant by a tick with a pump flow; return the pumped flow (m3/s)."""
        (self.x1, self.x2, self._layer), flows = step(
            self.plant, State(self.x1, self.x2, self._layer), rain, evapotranspiration, 0.0, 1.0,
            flow,
        )
        self.x1 -= self.leak * self.tau
        return flows.pump

    def plant_flow(self, speed: float) -> float:
        """Return the pump's flow at a speed (m3/s), computed independently by the affinity laws."""
        head = self.x1 / self.site.a1 + speed**2 * self.site.c_hat - self.site.d
        return self.site.b * head**0.5 if head > 0 else 0.0

    def run(
        self, seconds: float, command: float | None, until: Callable[[Decision], bool] | None = None
    ) -> Decision:
        """Step for this long (s), or until a decision meets a condition."""
        decision = self.step(command)
        for _ in range(round(seconds / self.tau) - 1):
            if until is not None and until(decision):
                break
            decision = self.step(command)
        return decision
