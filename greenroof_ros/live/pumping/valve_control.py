"""Control of the outlet valve at every step: it opens as commanded unless an interlock is active.

The valve is open while its relay is on, and closes when the relay is off. It makes whole openings,
and at most so many moves an hour. The safe state is closed: the overflow above the outlet protects
the building.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from greenroof_ros.base.parameter import Parameter, entry, parameters_of
from greenroof_ros.base.times import duration
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.interlocks import Decision, evaluate, state_of
from greenroof_ros.live.pumping.limits import UsageLimits, find_unknown
from greenroof_ros.live.pumping.state_file import DAY_S, SAVE_EVERY_S, StateFile
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.storm_water import (
    HOUR_S,
    OPENS_AT,
    REST,
    SINCE,
    make_valve,
    move_valve,
    time_without_rain,
)
from greenroof_ros.site.site import Site

# Travel time of the valve (s), and maximum number of its moves in an hour, if the site file does
# not state them.
TRAVEL_S, _MOVES = 30.0, 4.0
# Rain that is unknown for longer than this, also while the node is not running, counts as rain (s).
_UNSEEN_S = 180.0
# Averaging time of the cistern's level (s), how long an open valve must have drained (s), and
# movement of the level that evaporation or the drift of its sensor may cause (m/s).
_AVERAGING_S, _DRAINS_FOR_S, _DRIFT = 60.0, 600.0, 1e-3 / 3600
# Margin of what was pumped, since the pump's flow is not exact; and the share of the expected
# volume that must at least have left through an open valve.
_PUMPED, _LEAST = 1.25, 0.1


@dataclass(frozen=True)
class ValveObservation:
    """Observations at a step; None stands for a value that is unknown or too old.

    Attributes:
        command: share to which the controller opens the valve.
        cistern_level: level of the cistern (m).
        frost: 1 if there is frost, otherwise 0.
        rain: rain at the gauge (m/s).
        pumped: flow of the pump (m3/s); 0 without a pump.
        on: whether the relay is on.
        opened: whether the end switch reports that the valve is open.
        closed: whether the end switch reports that the valve is closed.
        reasons: the node's own reasons for keeping the valve closed.
    """

    command: float | None = None
    cistern_level: float | None = None
    frost: float | None = None
    rain: float | None = None
    pumped: float | None = None
    on: bool | None = None
    opened: float | None = None
    closed: float | None = None
    reasons: Sequence[Diagnosis] = ()


@dataclass(frozen=True, kw_only=True)
class ValveSettings:
    """The limits of a valve and the thresholds of its checks, which are parameters."""

    has_switches: bool = entry("whether the valve has both end switches", default=False)
    opens_in_wet_weather: bool = entry(
        "whether the valve may be open in wet weather, as with the policy open", default=False
    )
    max_run: float = entry(
        "maximum time open without as long a break; by default, 1.5 times the time in which the "
        "outlet empties a full cistern", 1.0, DAY_S, unit="s",
    )
    max_volume_per_day: float = entry(
        "maximum volume released in any 24 h; by default, twice the volume above the low outlet",
        1e-6, 1e9, unit="m3",
    )
    leak_tolerance: float = entry(
        "tolerated unexplained fall of the cistern's level, beyond 1 mm/h, with the valve closed",
        1e-3, 1.0, unit="m", default=0.02,
    )


def valve_parameters(site: Site) -> tuple[Parameter, ...]:
    """Return each setting as a parameter, with its default at a site with a valve."""
    p = plant_parameters(site)
    above = site.z_o - p.low_outlet_level
    emptied = 2 * p.a1 * math.sqrt(above) / p.c_low  # Torricelli
    of_site = {
        "max_run": min(DAY_S, round(1.5 * emptied) + 1.0),
        "max_volume_per_day": round(2 * p.a1 * above, 3),
    }
    return tuple(
        replace(setting, default=of_site.get(setting.name, setting.default))
        for setting in parameters_of(ValveSettings)
    )


class ValveControl:
    """Conversion of commands into openings, with the valve closed while an interlock is active.

    Attributes:
        opened_by: who opened the valve by hand last.
        open_for: for how long it will be open by hand (s); an interlock ends this.
        stuck: warning of a valve that does not open; None if there is none.
    """

    def __init__(
        self, site: Site, settings: ValveSettings, state_file: StateFile,
        relay_stops_after: float,
    ) -> None:
        """Start with the valve closed, and the rain unknown unless the state file knows it.

        Args:
            site: a site with a valve.
            settings: the valve's limits.
            state_file: state file, with the state before this start.
            relay_stops_after: time after which a relay that does not respond is off (s).
        """
        self._site, self._settings, self._state_file = site, settings, state_file
        self._p = plant_parameters(site)
        self._travel = site.valve_travel_time or TRAVEL_S
        self._closes_after = relay_stops_after + self._travel
        full = low_outlet_flow(self._p, self._p.a1 * site.z_o)
        state_file.count_unseen(self._closes_after + SAVE_EVERY_S, full)
        self._unseen_for = state_file.unseen_s  # for how long nobody has seen whether it rains (s)
        self._usage = UsageLimits(
            state_file, settings.max_run, settings.max_volume_per_day, "valve"
        )
        self._moves_of = [*make_valve(site.valve_moves_per_hour or _MOVES)]
        self._moves_of[SINCE] = state_file.state.since_start  # it closed then, or later
        self.opened_by, self.open_for = "", 0.0
        self._on = False
        # Time until the valve is surely closed (s), if its relay stays off or silent.
        self._closes_in = self._closes_after
        self.discard_evidence()

    def discard_evidence(self) -> None:
        """Discard the evidence that led to a fault, since the fault has been cleared."""
        self.stuck: Diagnosis | None = None
        self._against_for = 0.0
        self._begin_balance(None)

    def step(self, dt: float, observed: ValveObservation) -> Decision:
        """Determine the state of the valve for this step.

        Args:
            dt: time since the last step (s).
            observed: present observations.
        """
        file, level, has_switches = (
            self._state_file, observed.cistern_level, self._settings.has_switches
        )
        most = low_outlet_flow(self._p, self._p.a1 * (self._site.z_o if level is None else level))
        self.open_for = max(0.0, self.open_for - dt)
        if self._on or observed.on:
            self._closes_in = self._closes_after
        elif observed.on is False:
            self._closes_in = min(self._closes_in, self._travel)
        self._closes_in -= dt
        switches = (observed.opened, observed.closed) if has_switches else (None, None)
        position = switches[0] if None not in switches and switches[0] != switches[1] else None
        at_rest = position == 0 if has_switches else self._closes_in <= 0
        file.count(dt, 0.0 if at_rest else most * dt)
        self._note_rain(dt, observed.rain)
        active = evaluate(file, [
            *self._limits(observed), *self._check_switches(dt, switches, position),
            *self._check_water(dt, observed, at_rest), *observed.reasons,
        ])
        before, valve = self._on, self._moves_of
        if active:
            self.open_for = 0.0
        command = 1.0 if self.open_for else observed.command or 0.0
        may_open = not active and (self._on or at_rest)
        self._on = move_valve(valve, dt, command if may_open else 0.0) > 0
        if self._on != before:
            file.switch(self._on)
        state, why = "closed", "the command is 0"
        if active:
            state, why = state_of(active)
            if state != "fault":
                state = "held" if "hold" in active else "closed"
        elif self._on:
            is_open = position == 1 if has_switches else file.state.since_start >= self._travel
            state = "open" if is_open else "opening"
            why = f"opened by {self.opened_by}" if self.open_for else "as commanded"
        elif command >= OPENS_AT:
            again = duration(math.ceil(max(0.0, valve[REST] - valve[SINCE])))
            why = f"it may open in {again}, so that it does not move too often"
        if not self._on and not at_rest and state != "fault":
            lost = observed.on is None
            why += "; it is unknown whether it has closed" if lost else "; it is closing"
            state = ("unknown" if lost else "closing") if state == "closed" else state
        return Decision(
            active, state, why, at_rest, speed=None if observed.on is None else float(observed.on),
            flow=None if position is None or level is None else position * most,
            request=1.0 if self._on else None, position=position,
        )

    # --- limits and faults ------------------------------------------------------------------------

    def _note_rain(self, dt: float, rain: float | None) -> None:
        """Count the time without rain, in which a short time of unknown rain does not count."""
        file = self._state_file
        before, is_late = file.state.without_rain, self._unseen_for + dt > _UNSEEN_S
        self._unseen_for = self._unseen_for + dt if rain is None else 0.0
        dry = 0.0 if is_late else before
        if rain is not None and not is_late:
            dry = time_without_rain(before, rain, dt)
        file.state = replace(file.state, without_rain=dry)
        if (dry == 0) != (before == 0):
            file.save()

    def _limits(self, observed: ValveObservation) -> Iterator[Diagnosis]:
        site, settings = self._site, self._settings
        switches = (observed.opened, observed.closed) if settings.has_switches else ()
        known = {
            "cistern_level": observed.cistern_level,
            "command": 1.0 if self.open_for else observed.command,
            "frost": 0.0 if site.valve_closed_in_frost is False else observed.frost,
            "rain": 0.0 if settings.opens_in_wet_weather else observed.rain,
            "position": None if None in switches else 0.0,
        }
        yield from find_unknown(known)
        if known["frost"]:
            yield Diagnosis.of("frost")
        rest = site.wet_after * HOUR_S - self._state_file.state.without_rain
        if observed.rain is not None and rest > 0 and not settings.opens_in_wet_weather:
            yield Diagnosis.of("wet_weather", rest=rest)
        yield from self._usage.reasons(self._on)

    def _check_switches(
        self, dt: float, switches: tuple[float | None, float | None], position: float | None
    ) -> Iterator[Diagnosis]:
        """Yield the faults that the end switches show after the travel time."""
        agrees = None in switches or position == float(self._on)
        self._against_for = 0.0 if agrees else self._against_for + dt
        passed, is_late = self._against_for, self._against_for > self._travel
        if not self._on and passed <= self._closes_after:
            is_late = is_late and self._closes_in <= 0  # a relay that is lost may still be on
        if self._settings.has_switches:
            self.stuck = Diagnosis.of(
                "valve_stuck_closed", "switch", time=passed
            ) if is_late and self._on else None
        if is_late and switches == (1.0, 1.0):
            yield Diagnosis.of("switches_disagree", time=passed)
        elif is_late and not self._on:
            yield Diagnosis.of("valve_stuck_open", time=passed)

    # --- the water balance of the cistern ---------------------------------------------------------

    def _begin_balance(self, is_open: bool | None) -> None:
        """Begin anew when the valve has moved; None while it moves."""
        self._was_open = is_open
        self._elapsed = self._drawn = self._expected = 0.0
        self._mean, self._highest = math.nan, -math.inf

    def _check_water(
        self, dt: float, observed: ValveObservation, at_rest: bool
    ) -> Iterator[Diagnosis]:
        """Yield the fault of a valve that leaks; find out whether an open valve drains."""
        is_open = self._on if at_rest or self._on else None
        if self._on and self._state_file.state.since_start < self._travel:
            is_open = None
        level, p = observed.cistern_level, self._p
        if is_open is not self._was_open or level is None or observed.pumped is None:
            self._begin_balance(is_open)
        if is_open is None or level is None or observed.pumped is None:
            return
        self._elapsed += dt
        self._drawn += (_PUMPED * observed.pumped + _DRIFT * p.a1) * dt
        self._expected += low_outlet_flow(p, p.a1 * level) * dt
        weight = dt / min(_AVERAGING_S, self._elapsed) if self._elapsed else 1.0
        self._mean = level if math.isnan(self._mean) else (
            self._mean + weight * (level - self._mean)
        )
        if self._elapsed < _AVERAGING_S:
            return
        volume, tolerance = p.a1 * self._mean + self._drawn, p.a1 * self._settings.leak_tolerance
        self._highest = max(self._highest, volume)
        fell, minutes = self._highest - volume, self._elapsed / 60
        if not is_open and fell > tolerance:
            yield Diagnosis.of("valve_leaks", volume=fell, minutes=minutes)
        if not self._settings.has_switches:
            is_stuck = (
                self._elapsed > _DRAINS_FOR_S and self._expected > 3 * tolerance
                and fell < _LEAST * self._expected
            )
            self.stuck = Diagnosis.of(
                "valve_stuck_closed", "level", minutes=minutes, expected=self._expected
            ) if is_open and is_stuck else None
