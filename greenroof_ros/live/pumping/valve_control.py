"""Control of the outlet valve at every step: it opens as commanded unless an interlock is active.

The valve is open while its relay is on, and closes when the relay is off. It makes whole openings,
and at most so many moves an hour. The safe state is closed: the overflow above the outlet protects
the building.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from greenroof_ros.base.parameter import Parameter, entry, parameters_of
from greenroof_ros.base.times import duration
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.interlocks import Decision, evaluate, state_of
from greenroof_ros.live.pumping.state_file import DAY_S, SAVE_EVERY_S, StateFile
from greenroof_ros.physics.cistern import low_outlet_flow
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import maximum_pump_flow
from greenroof_ros.physics.storm_water import HOUR_S, time_without_rain
from greenroof_ros.site.site import Site

TRAVEL_S, MOVES = 30.0, 4.0
"""travel time of the valve (s), and maximum number of its moves in an hour, if the site file does
not state them"""
# A restart that is longer than this counts as a time of unknown rain (s).
_UNSEEN_S = 180.0
# A command of this share, or more, opens the valve.
_OPENS = 0.5
# Averaging time of the cistern's level (s), and movement of the level that evaporation or the drift
# of its sensor may cause (m/s).
_AVERAGING_S, _DRIFT = 60.0, 1e-3 / 3600
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

    has_switches: bool = entry(
        "whether the valve has end switches, so that its position is known", default=False,
    )
    opens_in_wet_weather: bool = entry(
        "whether the valve may be open in wet weather; bringup sets this for the policy open, and "
        "for a controller of your own whose class has opens_in_wet_weather = True", default=False,
    )
    max_open: float = entry(
        "maximum time open without a break of the same length; by default, 1.5 times the time in "
        "which the outlet empties a full cistern, at most 24 h", 1.0, DAY_S, unit="s",
    )
    max_release_per_day: float = entry(
        "maximum volume released in any 24 h; by default, twice the volume above the low outlet",
        1e-6, 1e9, unit="m3",
    )
    leak_tolerance: float = entry(
        "fall of the cistern's level that a closed valve may not explain, in excess of 1 mm/h; "
        "must exceed the noise of the sensor", 1e-3, 1.0, unit="m", default=0.02,
    )


def valve_parameters(site: Site) -> tuple[Parameter, ...]:
    """Return each setting as a parameter, with its default at a site with a valve."""
    p = plant_parameters(site)
    above = site.z_o - p.low_outlet_level
    emptied = 2 * p.a1 * math.sqrt(above) / p.c_low  # Torricelli
    of_site = {
        "max_open": min(DAY_S, round(1.5 * emptied) + 1.0),
        "max_release_per_day": round(2 * p.a1 * above, 3),
    }
    return tuple(
        replace(setting, default=of_site.get(setting.name, setting.default))
        for setting in parameters_of(ValveSettings)
    )


class OutletBalance:
    """The water balance of the cistern, which detects what the valve does not report."""

    def __init__(self, site: Site, tolerance: float) -> None:
        """Begin without evidence.

        Args:
            site: the site.
            tolerance: fall of the level that counts as none (m).
        """
        self._p, self._tolerance = plant_parameters(site), tolerance
        self.begin(None)

    def begin(self, is_open: bool | None) -> None:
        """Begin anew when the valve has moved; None if its position is unknown."""
        self._is_open = is_open
        self._elapsed = self._drawn = self._expected = 0.0
        self._mean = self._highest = math.nan

    def step(
        self, dt: float, is_open: bool | None, level: float | None, pumped: float
    ) -> tuple[Diagnosis | None, Diagnosis | None]:
        """Return the fault of a valve that leaks, and the warning of one that does not open.

        Args:
            dt: time since the last step (s).
            is_open: whether the valve should be open; None while it moves.
            level: level of the cistern (m); None if unknown.
            pumped: volume that may have been pumped since the last step (m3).
        """
        if is_open is not self._is_open or level is None:
            self.begin(is_open)
        if is_open is None or level is None:
            return None, None
        p, first = self._p, math.isnan(self._mean)
        self._elapsed += dt
        weight = 1.0 if first else dt / min(_AVERAGING_S, self._elapsed + dt)
        self._mean = level if first else self._mean + weight * (level - self._mean)
        self._drawn += _PUMPED * pumped + _DRIFT * p.a1 * dt
        self._expected += low_outlet_flow(p, p.a1 * level) * dt
        if self._elapsed < _AVERAGING_S:
            return None, None
        volume, tolerance = p.a1 * self._mean + self._drawn, p.a1 * self._tolerance
        self._highest = volume if math.isnan(self._highest) else max(self._highest, volume)
        fell = self._highest - volume
        if not is_open:
            leaks = fell > tolerance
            return Diagnosis.of(
                "valve_leaks", volume=fell, minutes=self._elapsed / 60
            ) if leaks else None, None
        is_stuck = self._expected > 3 * tolerance and fell < _LEAST * self._expected
        return None, Diagnosis.of(
            "valve_stuck_closed", "level", minutes=self._elapsed / 60, expected=self._expected
        ) if is_stuck else None


class ValveControl:
    """Conversion of commands into openings, with the valve closed while an interlock is active.

    Attributes:
        opened_by: who opens the valve by hand; empty if nobody does.
        open_until: end of the opening by hand (s since 1970).
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
        self._pause = 2 * HOUR_S / (site.valve_moves_per_hour or MOVES)
        self._wet_after = site.wet_after * HOUR_S
        self._stops_after = relay_stops_after + self._travel
        full = low_outlet_flow(self._p, site.cistern_volume(site.z_o))
        state_file.count_unseen(self._stops_after + SAVE_EVERY_S, full)
        if state_file.unseen_s > _UNSEEN_S:
            state_file.change(without_rain=0.0)
        self.opened_by, self.open_until = "", -math.inf
        self.stuck: Diagnosis | None = None
        self._max_pumped = maximum_pump_flow(self._p, self._p.a1 * site.z_o)
        self._on, self._on_for, self._rests_until = False, 0.0, 0.0
        # For how long the valve may still be open after its relay was last known to be on (s).
        self._may_be_open_for = self._stops_after
        self._off_for = 0.0
        self.discard_evidence()

    def discard_evidence(self) -> None:
        """Discard the evidence that led to a fault, since the fault has been cleared."""
        self._balance = OutletBalance(self._site, self._settings.leak_tolerance)
        self._against_for = 0.0

    def open_by_hand(self, owner: str, until: float) -> None:
        """Open the valve until a time (s since 1970), unless an interlock is active."""
        self.opened_by, self.open_until = owner, until

    @property
    def is_by_hand(self) -> bool:
        """Whether a person keeps the valve open."""
        return time.time() < self.open_until

    def step(self, dt: float, observed: ValveObservation) -> Decision:
        """Determine the state of the valve for this step.

        Args:
            dt: time since the last step (s).
            observed: present observations.
        """
        file, level = self._state_file, observed.cistern_level
        position = self._find_position(observed)
        self._off_for = self._off_for + dt if observed.on is False and not self._on else 0.0
        at_rest = position == 0 if self._settings.has_switches else self._off_for >= self._travel
        if observed.on is None:
            self._may_be_open_for -= dt
            springs = self._site.valve_without_power != "may_stay_open"
            at_rest = at_rest or (springs and self._may_be_open_for <= 0)
        else:
            self._may_be_open_for = self._stops_after
        self._on_for = self._on_for + dt if self._on else 0.0
        volume = self._p.a1 * (self._site.z_o if level is None else level)
        most = low_outlet_flow(self._p, volume)
        file.count(dt, 0.0 if at_rest else most * dt)
        rain = math.nan if observed.rain is None else observed.rain
        without = time_without_rain(file.state.without_rain, rain, dt)
        if (without == 0) != (file.state.without_rain == 0):
            file.change(without_rain=without)
        file.state = replace(file.state, without_rain=without)
        leaks = self._check_water(dt, observed, at_rest)
        active = evaluate(file, [
            *self._limits(observed), *self._faults(dt, observed, position),
            *filter(None, (leaks,)), *observed.reasons,
        ])
        before, why = self._on, "the command is 0"
        self._on = not active and self._may_open(observed)
        if active:
            state, why = state_of(active)
            if state != "fault":
                state = "held" if "hold" in active else "closed"
        elif self._on:
            why = f"opened by {self.opened_by}" if self.is_by_hand else "as commanded"
            state = "open" if position == 1 or self._on_for >= self._travel else "opening"
        else:
            state = "closed"
            if self._wants_open(observed):
                why = self._why_closed()
        if self._on != before:
            file.switch(self._on)
            self._balance.begin(None)
        if not self._on and not at_rest:
            why += "; it is closing"
            state = "closing" if state == "closed" else state
        if observed.on is None and not at_rest:
            why += "; it is unknown whether the valve has closed"
            state = "unknown" if state in ("closing", "closed") else state
        flow = 0.0 if at_rest and position == 0 else None
        if position is not None and level is not None:
            flow = position * most
        speed = None if observed.on is None else float(observed.on)
        return Decision(
            active, state, why, at_rest, speed, flow, 1.0 if self._on else None, position
        )

    # --- opening --------------------------------------------------------------------------------

    def _wants_open(self, observed: ValveObservation) -> bool:
        return self.is_by_hand or (observed.command or 0.0) >= _OPENS

    def _wait(self) -> float:
        """Return the time until the valve may open again (s)."""
        starts, now = self._state_file.state.starts, self._state_file.state.elapsed
        return 0.0 if not starts else max(0.0, starts[-1] + self._pause - now)

    def _may_open(self, observed: ValveObservation) -> bool:
        """Return whether the valve is to be open; it is closed first after a start."""
        if not self._wants_open(observed):
            return False
        return self._on or (self._wait() == 0 and self._may_start)

    @property
    def _may_start(self) -> bool:
        return self._off_for >= self._travel

    def _why_closed(self) -> str:
        if wait := self._wait():
            moves = self._site.valve_moves_per_hour or MOVES
            return f"it may open in {duration(math.ceil(wait))}: at most {moves:g} moves an hour"
        return "it is closed first"

    # --- reasons to keep it closed --------------------------------------------------------------

    def _limits(self, observed: ValveObservation) -> Iterator[Diagnosis]:
        site, settings, stored = self._site, self._settings, self._state_file.state
        if observed.command is None and not self.is_by_hand:
            yield Diagnosis.of("command_unknown")
        if observed.cistern_level is None:
            yield Diagnosis.of("cistern_level_unknown")
        if site.valve_closed_in_frost is not False:
            if observed.frost is None:
                yield Diagnosis.of("frost_unknown")
            elif observed.frost:
                yield Diagnosis.of("frost")
        if not settings.opens_in_wet_weather:
            if observed.rain is None:
                yield Diagnosis.of("rain_unknown")
            elif (dry := stored.without_rain) < self._wet_after:
                yield Diagnosis.of("wet_weather", rest=self._wet_after - dry)
        if self._on_for >= settings.max_open:
            self._rests_until = stored.elapsed + settings.max_open
        if (rest := self._rests_until - stored.elapsed) > 0:
            yield Diagnosis.of("max_open", max=settings.max_open, rest=rest)
        if stored.day_volume >= settings.max_release_per_day:
            yield Diagnosis.of(
                "daily_release", volume=stored.day_volume, limit=settings.max_release_per_day,
                again=stored.clears_in(settings.max_release_per_day),
            )
        if settings.has_switches and None in (observed.opened, observed.closed):
            yield Diagnosis.of("position_unknown")

    def _find_position(self, observed: ValveObservation) -> float | None:
        """Return the position by the end switches: 1 open, 0 closed, None unknown or between."""
        opened, closed = observed.opened, observed.closed
        if not self._settings.has_switches or None in (opened, closed) or opened == closed:
            return None
        return opened

    def _faults(
        self, dt: float, observed: ValveObservation, position: float | None
    ) -> Iterator[Diagnosis]:
        """Yield the faults that the end switches show."""
        self.stuck = None if self._settings.has_switches else self.stuck
        if not self._settings.has_switches or None in (observed.opened, observed.closed):
            return
        self._against_for = 0.0 if position == float(self._on) else self._against_for + dt
        if self._against_for <= self._travel:
            return
        if observed.opened and observed.closed:
            yield Diagnosis.of("switches_disagree", time=self._against_for)
        elif self._on:
            self.stuck = Diagnosis.of("valve_stuck_closed", "switch", time=self._against_for)
        else:
            yield Diagnosis.of("valve_stuck_open", time=self._against_for)

    def _check_water(
        self, dt: float, observed: ValveObservation, at_rest: bool
    ) -> Diagnosis | None:
        """Return the fault if the cistern loses water; find out whether an open valve drains it."""
        is_open = True if self._on and self._on_for >= self._travel else None
        if not self._on and at_rest:
            is_open = False
        pumped = self._max_pumped if observed.pumped is None else observed.pumped
        leaks, stuck = self._balance.step(dt, is_open, observed.cistern_level, pumped * dt)
        if not self._settings.has_switches:
            self.stuck = stuck
        return leaks
