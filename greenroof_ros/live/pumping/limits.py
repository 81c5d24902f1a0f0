"""Limits of a pump: settings, reasons for keeping it off, and pulses below the minimum flow.

Inhibits caused by a limit clear automatically.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter, entry, parameters_of
from greenroof_ros.base.times import to_people
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.pump_inputs import Observation
from greenroof_ros.live.pumping.state_file import DAY_S, StateFile
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import flow_at, maximum_pump_flow, speed_for
from greenroof_ros.physics.soil import retained_share, water_to_raise
from greenroof_ros.site.site import Site

_HOUR_S = 3600.0
# A pump that runs continuously makes up the outstanding volume in this time (s).
_CATCH_UP = 60.0
_MIN_FLOW = 0.2
# No command asks for less (m3/s), except in theory.
_LEAST_FLOW = 1e-9
# More than the reference evapotranspiration in any climate of FAO-56, Table 2 (m/day).
_MAX_EVAPOTRANSPIRATION = 0.010
# Margin of the daily volume, since the flow is only estimated.
_MARGIN = 1.5
# How far above the level of a dry-run cut the cistern must be before the pump runs again (m).
_HYSTERESIS = 0.02
# Permitted difference between the speed and the requested speed, as a share of the rated speed.
_FAR = 0.1


def _volume_per_day(site: Site) -> float:
    """Return the volume (m3) needed to fill an empty roof and replace a day's loss, plus a margin.

    The loss is the maximum evapotranspiration. A field-capacity soil needs a larger volume, since
    it retains only a share of the pumped water.
    """
    evapotranspiration = _MAX_EVAPOTRANSPIRATION * site.crop_coefficient * site.a2
    replaced = evapotranspiration / retained_share(plant_parameters(site), site.x2_star)
    return round(_MARGIN * (_filling(site) + replaced), 3)


def _filling(site: Site) -> float:
    """Return the volume (m3) needed to fill an empty roof to its target."""
    return water_to_raise(plant_parameters(site), 0.0, site.x2_star)


def _time_for(site: Site, volume: float) -> float:
    """Return the time (s) in which the default min_flow delivers a volume (m3); at most a day."""
    min_flow = _MIN_FLOW * maximum_pump_flow(site, site.cistern_volume(site.suction_level))
    return min(DAY_S, round(volume / min_flow) + 1.0)


@dataclass(frozen=True, kw_only=True)
class PumpSettings:
    """The limits of a pump and the thresholds of its checks.

    Every field specifies its meaning, range, unit and default. Some defaults depend on the site;
    :func:`pump_parameters` returns all defaults.
    """

    min_speed: float = entry(
        "minimum speed of the drive, as a share of the rated speed; the drive file may specify a "
        "higher minimum",
        0.05, 1.0, unit="1", default=0.3,
    )
    min_flow: float = entry(
        "minimum flow for continuous operation, as a share of the maximum flow; a smaller flow "
        "is delivered in pulses",
        0.01, 1.0, unit="1", default=_MIN_FLOW,
    )
    min_on: float = entry(
        "minimum time for which the pump must stay on after a "
        "start", 0.0, 3600.0, unit="s", default=10.0
    )
    min_off: float = entry(
        "minimum time for which the pump must stay off after a "
        "stop", 0.0, 3600.0, unit="s", default=10.0
    )
    starts_per_hour: float = entry(
        "maximum number of starts in any hour; by default, the number in the site "
        "file", 1.0, 3600.0, unit="1/h"
    )
    max_run: float = entry(
        "maximum time on without a break; by default, the time in which a fifth of the maximum "
        "flow fills an empty roof",
        1.0, DAY_S, unit="s",
    )
    max_run_per_day: float = entry(
        "maximum time on in any 24 h; by default, the time in which a fifth of the maximum flow "
        "delivers the default of max_volume_per_day",
        1.0, DAY_S, unit="s",
    )
    max_volume_per_day: float = entry(
        "maximum volume pumped in any 24 h; by default, 1.5 times the volume that fills an empty "
        "roof and replaces 10 mm of evapotranspiration",
        1e-6, 1e9, unit="m3",
    )
    drive_ramp: float = entry(
        "duration of the drive's own ramp between standstill and rated speed, up or down, "
        "whichever is longer; the default is the maximum permitted",
        0.0, 30.0, unit="s", default=30.0,
    )
    follow_time: float = entry(
        "maximum time for which the speed may deviate from the requested speed (during a ramp, "
        "from the speed that the ramp should have reached) before a fault is latched",
        0.1, 600.0, unit="s", default=12.0,
    )
    averaging_time: float = entry(
        "averaging time of the levels and volumes in the delivery check",
        1.0, 3600.0, unit="s", default=60.0,
    )
    level_tolerance: float = entry(
        "maximum unexplained change of a mean level that the delivery check tolerates; must exceed "
        "the sensor's resolution. The default is 13 times the noise of the mean if readings arrive "
        "every second with errors of 5 mm",
        1e-4, 1.0, unit="m", default=0.006,
    )
    level_offset: float = entry(
        "maximum systematic error of a level sensor, in either direction; also the height above "
        "the suction level at which the dry-run protection stops the pump",
        0.0, 1.0, unit="m", default=0.02,
    )
    min_delivery: float = entry(
        "minimum share of the pumped volume that must reach the roof; the cistern may lose at "
        "most the pumped volume divided by this share",
        0.05, 0.95, unit="1", default=0.5,
    )
    max_loss: float = entry(
        "maximum rate of change of a level that the delivery check attributes to "
        "evapotranspiration or to the drift of a sensor",
        0.01, 1000.0, unit="mm/h", default=1.0,
    )

    @property
    def follow_tolerance(self) -> float:
        """Permitted difference from the requested speed, as a share of the rated speed.

        The tolerance is below the minimum speed, so a stopped pump is never treated as running, and
        a pump that runs on after a stop is never treated as stopped.
        """
        return min(_FAR, self.min_speed / 2)


def pump_parameters(site: Site) -> tuple[Parameter, ...]:
    """Return each setting as a parameter, with its default at this site."""
    of_site = {
        "starts_per_hour": site.starts_per_hour,
        "max_run": _time_for(site, _filling(site)),
        "max_run_per_day": _time_for(site, _volume_per_day(site)),
        "max_volume_per_day": _volume_per_day(site),
    }
    return tuple(
        replace(entry, default=of_site.get(entry.name, entry.default))
        for entry in parameters_of(PumpSettings)
    )


class PumpLimits:
    """Limits on time off, starts, run time, usage in 24 h, cistern level, frost and quiet hours.

    After the node starts, the pump first waits for the minimum time off, since it is unknown how
    long it has been off.
    """

    def __init__(self, site: Site, settings: PumpSettings, state_file: StateFile) -> None:
        self._site = site
        self._settings = settings
        self._state_file = state_file
        self._off_since = state_file.state.elapsed
        self._dry = False
        self._on_for = 0.0
        self._rests_for = 0.0

    @property
    def since_start(self) -> float:
        """Time since the last start (s)."""
        stored = self._state_file.state
        return stored.elapsed - stored.starts[-1] if stored.starts else math.inf

    def switch(self, on: bool) -> None:
        """Count a start or a stop."""
        self._state_file.switch(on)
        if not on:
            self._off_since = self._state_file.state.elapsed

    def wait(self) -> tuple[float, str]:
        """Return the time until a pump that is off may start (s), and the reason."""
        now, starts = self._state_file.state.elapsed, self._state_file.state.starts
        min_off, allowed = self._settings.min_off, int(self._settings.starts_per_hour)
        waits = [
            (0.0, ""),
            (min_off - (now - self._off_since), f"it must stay off for at least {min_off:g} s"),
        ]
        if len(starts) >= allowed:
            again = starts[-allowed] + _HOUR_S - now
            waits.append((again, f"it may start at most {allowed} times an hour"))
        return max(waits)

    def count(self, dt: float, on: bool) -> None:
        """Count time during which the pump was on or off (s)."""
        if on:
            self._on_for += dt
            if self._on_for >= self._settings.max_run:
                self._rests_for = self._settings.max_run
        else:
            self._on_for = 0.0
            self._rests_for = max(0.0, self._rests_for - dt)

    def reasons(self, command: float | None, observed: Observation) -> Iterator[Diagnosis]:
        """Yield the current reasons for keeping the pump off; must be called at every step.

        Args:
            command: share of the maximum flow; 0 ends the pause after the longest permitted run,
                whereas None (no valid command) does not.
            observed: present observations.
        """
        settings, stored = self._settings, self._state_file.state
        cistern_level, time_ns = observed.cistern_level, observed.time_ns
        if cistern_level is None:
            yield Diagnosis.of("cistern_level_unknown")
        else:
            minimum = self._site.suction_level + settings.level_offset
            if self._dry:
                minimum += _HYSTERESIS
            self._dry = cistern_level <= minimum
            if self._dry:
                yield Diagnosis.of("cistern_low", level=cistern_level, min=minimum)
        if observed.roof_level is None:
            yield Diagnosis.of("roof_level_unknown")
        if observed.frost is None:
            yield Diagnosis.of("frost_unknown")
        elif observed.frost:
            yield Diagnosis.of("frost")
        if (quiet := self._site.quiet) is not None and quiet.quiet_at(time_ns):
            yield Diagnosis.of("quiet_hours", until=to_people(quiet.end_after(time_ns)))
        if command == 0:
            self._rests_for = 0.0
        if self._rests_for > 0:
            yield Diagnosis.of("max_run", max=settings.max_run, rest=self._rests_for)
        if stored.day_volume >= settings.max_volume_per_day:
            yield Diagnosis.of(
                "daily_volume", volume=stored.day_volume, limit=settings.max_volume_per_day,
                again=stored.clears_in(volume=settings.max_volume_per_day),
            )
        if stored.day_run >= settings.max_run_per_day:
            yield Diagnosis.of(
                "daily_run", run=stored.day_run, limit=settings.max_run_per_day,
                again=stored.clears_in(run=settings.max_run_per_day),
            )


class Pulses:
    """Conversion of a command into a flow that the pump can deliver, continuously or in pulses.

    Below its minimum flow, a pump overheats; below its minimum speed, it delivers nothing. The
    minimum share is the larger of the two corresponding flows. A smaller command is delivered
    in pulses at the minimum share. A minimum pulse is the volume that this share delivers in the
    minimum time on. The outstanding volume is the commanded volume minus the volume that the actual
    flow has delivered. A pulse begins when a minimum pulse will be outstanding by its end, and ends
    when nothing is outstanding. The pump therefore lags the command by at most a minimum pulse, and
    exceeds it only by the flow of one step and the flow while the pump is coming to a standstill.

    The outstanding volume is limited, so that the pump does not catch up on obsolete demand:

    - an interlock, unmonitored time and the end of a dose set it to 0;
    - if the demand is 0 (command 0, or a full roof) or at least the minimum share, it is at most
      one minimum pulse;
    - in between, it is at most the volume that the minimum share delivers from one permitted start
      to the next (in 180 s with 20 starts an hour), or a minimum pulse if that is more.

    Attributes:
        outstanding: commanded minus delivered volume (m3), within its limits; negative if the
            minimum time on delivered more than was commanded.
    """

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site = site
        self._settings = settings
        self._spacing = _HOUR_S / settings.starts_per_hour
        self.clear()

    def min_share(self, cistern_level: float) -> float:
        """Return the minimum share of the maximum flow that may be requested at a level (m)."""
        slowest = flow_at(self._site, self._settings.min_speed, cistern_level)
        return max(self._settings.min_flow, slowest / self._flow(1.0, cistern_level))

    def min_pulse(self, cistern_level: float) -> float:
        """Return the volume that the minimum share delivers in the minimum time on (m3)."""
        return self._settings.min_on * self._flow(self.min_share(cistern_level), cistern_level)

    def speed(self, share: float, cistern_level: float) -> float:
        """Return the speed for a share of the flow, from the minimum speed to 1."""
        speed = speed_for(self._site, share, cistern_level)
        return min(1.0, max(self._settings.min_speed, speed))

    def count(self, delivered: float, dt: float) -> None:
        """Subtract the volume delivered in dt (m3), and add the volume that `update` demanded."""
        self._set_outstanding(self.outstanding + self._wanted * dt - delivered)

    def clear(self) -> None:
        """Reset the outstanding volume and the demand."""
        self._wanted = self._maximum = self.outstanding = 0.0

    def update(self, command: float, cistern_level: float, on: bool, since_start: float) -> float:
        """Update the demand, and return the requested share of the maximum flow, 0 for off.

        Args:
            command: share of the maximum flow, 0 to 1.
            cistern_level: level of the cistern (m), from which the pump lifts the water.
            on: whether the pump is on.
            since_start: time since the pump was last started (s).
        """
        minimum, pulse = self.min_share(cistern_level), self.min_pulse(cistern_level)
        self._wanted, self._maximum = self._flow(command, cistern_level), pulse
        if 0 < command < minimum:
            self._maximum = max(pulse, self._spacing * self._flow(minimum, cistern_level))
        self._set_outstanding(self.outstanding)
        if command >= minimum:
            catch_up = self.outstanding / _CATCH_UP / self._flow(1.0, cistern_level)
            return min(1.0, max(minimum, command + catch_up))
        due = command > 0 and self.outstanding > 0
        if not on:
            by_its_end = self.outstanding + self._settings.min_on * self._wanted
            due = due and by_its_end >= pulse and since_start >= self._spacing
        return minimum if due else 0.0

    def due_in(self, cistern_level: float, since_start: float) -> float:
        """Return the time until the next pulse (s), if the command, which is not 0, stays as it is.

        Args:
            cistern_level: level of the cistern (m).
            since_start: time since the pump was last started (s).
        """
        lacking = self.min_pulse(cistern_level) - self.outstanding
        filled_in = lacking / max(self._wanted, _LEAST_FLOW) - self._settings.min_on
        return max(0.0, self._spacing - since_start, filled_in)

    def _set_outstanding(self, volume: float) -> None:
        self.outstanding = min(self._maximum, max(-self._maximum, volume))

    def _flow(self, share: float, cistern_level: float) -> float:
        return share * flow_at(self._site, 1.0, cistern_level)


def check_command_limit(limit: float, tau: float, key: str) -> None:
    """Check that a command may be older than a tick, since one command arrives per tick.

    Args:
        limit: the parameter ``command_limit`` of the pump node (s).
        tau: duration of the site's tick (s).
        key: name of the parameter, for the message.

    Raises:
        ConfigurationError: if the pump would stop between two commands.
    """
    if limit <= tau:
        raise ConfigurationError(
            f"must exceed tau of the site, {tau:g} s, because one command arrives per tau: set a "
            "smaller tau in the site file, or a greater command_limit with --node-parameters",
            key=key, value=limit,
        )
