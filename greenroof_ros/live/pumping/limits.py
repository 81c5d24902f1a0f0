"""Limits of a pump: settings, reasons for keeping it off, and pulses below the minimum flow.

Inhibits caused by a limit clear automatically.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.base.parameter import Parameter, entry, parameters_of
from greenroof_ros.interface.conditions import Diagnosis
from greenroof_ros.live.pumping.state_file import DAY_S, StateFile
from greenroof_ros.physics.parameters import plant_parameters
from greenroof_ros.physics.pump import flow_at, maximum_pump_flow
from greenroof_ros.physics.soil import retained_share, water_to_raise
from greenroof_ros.site.site import Site

_HOUR_S = 3600.0
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


@dataclass(frozen=True)
class Observation:
    """Observations at a step; None stands for a value that is unknown or too old.

    Attributes:
        command: share of the maximum flow, as received.
        cistern_level: level of the cistern (m).
        roof_level: level of the roof (m).
        displacements: total displacements of both readings by jumps that water cannot cause (m).
        frost: frost signal: 1 if there is frost, otherwise 0.
        time_ns: system time (ns since 1970).
        speed: speed of the drive, as a share of the rated speed; negative if the pump turns
            backwards.
        flow: flow that a flow meter or, without one, the drive measures (m3/s).
        outlet_closed: whether the valve of the low outlet is known to be closed.
        reasons: the pump node's own reasons for keeping the pump off, among them the drive's fault.
    """

    command: float | None = None
    cistern_level: float | None = None
    roof_level: float | None = None
    displacements: tuple[float, float] = (0.0, 0.0)
    frost: float | None = None
    time_ns: int = 0
    speed: float | None = None
    flow: float | None = None
    outlet_closed: bool = False
    reasons: Sequence[Diagnosis] = ()


@dataclass(frozen=True, kw_only=True)
class PumpSettings:
    """The limits of a pump and the thresholds of its checks.

    Most fields are parameters with a meaning, range, unit and default. Some defaults depend on the
    site; :func:`pump_parameters` returns all defaults.
    """

    min_speed: float
    """minimum speed, as a share of the rated speed; the drive file specifies it"""
    min_flow: float = entry(
        "minimum flow without pulses, as a share of the maximum flow",
        0.01, 1.0, unit="1", default=_MIN_FLOW,
    )
    min_on: float = entry("minimum time on after a start", 0.0, 3600.0, unit="s", default=10.0)
    min_off: float = entry("minimum time off after a stop", 0.0, 3600.0, unit="s", default=10.0)
    max_run: float = entry(
        "maximum time on without as long a break; by default, the time in which a fifth of the "
        "maximum flow fills an empty roof",
        1.0, DAY_S, unit="s",
    )
    max_volume_per_day: float = entry(
        "maximum volume pumped in any 24 h; by default, 1.5 times the volume that fills an empty "
        "roof and replaces 10 mm of evapotranspiration",
        1e-6, 1e9, unit="m3",
    )
    follow_time: float = entry(
        "maximum time in which the speed comes no nearer to the requested speed",
        0.1, 600.0, unit="s", default=12.0,
    )
    level_tolerance: float = entry(
        "maximum unexplained change of a mean level in the delivery check; must exceed the "
        "sensor's resolution",
        1e-4, 1.0, unit="m", default=0.006,
    )
    level_offset: float = entry(
        "maximum systematic error of a level sensor; also the height above the suction level at "
        "which the pump stops",
        0.0, 1.0, unit="m", default=0.02,
    )

    @property
    def follow_tolerance(self) -> float:
        """Permitted difference from the requested speed, as a share of the rated speed.

        The tolerance is below the minimum speed, so a stopped pump is never treated as running, and
        a pump that runs on after a stop is never treated as stopped.
        """
        return min(_FAR, self.min_speed / 2)


def pump_parameters(site: Site) -> tuple[Parameter, ...]:
    """Return each setting as a parameter, with its default at this site.

    A field-capacity soil needs a larger volume a day, since it retains only a share of the water.
    """
    p = plant_parameters(site)
    filling = water_to_raise(p, 0.0, site.x2_star)  # m3
    evapotranspiration = _MAX_EVAPOTRANSPIRATION * site.crop_coefficient * site.a2
    per_day = _MARGIN * (filling + evapotranspiration / retained_share(p, site.x2_star))
    min_flow = _MIN_FLOW * maximum_pump_flow(p, site.cistern_volume(site.suction_level))
    of_site = {
        "max_run": min(DAY_S, round(filling / min_flow) + 1.0),
        "max_volume_per_day": round(per_day, 3),
    }
    return tuple(
        replace(setting, default=of_site.get(setting.name, setting.default))
        for setting in parameters_of(PumpSettings)
    )


def find_unknown(known: Mapping[str, float | None]) -> Iterator[Diagnosis]:
    """Yield a reason for every value that is unknown (None), by its name."""
    for name, value in known.items():
        if value is None:
            yield Diagnosis.of(f"{name}_unknown")


class UsageLimits:
    """The limits of an actuator's time on, and of its volume in 24 h."""

    def __init__(
        self, state_file: StateFile, max_run: float, max_volume_per_day: float, actuator: str
    ) -> None:
        """Set the limits.

        Args:
            state_file: state file, which counts starts and volumes.
            max_run: maximum time on without a break of the same length (s).
            max_volume_per_day: maximum volume in any 24 h (m3).
            actuator: ``pump`` or ``valve``, for the sentences.
        """
        self._state_file, self._actuator = state_file, actuator
        self._max_run, self._max_volume = max_run, max_volume_per_day
        self._rests_until = 0.0

    def reasons(self, on: bool) -> Iterator[Diagnosis]:
        """Yield the current reasons for keeping the actuator off; called at every step.

        Args:
            on: whether the actuator is on.
        """
        stored = self._state_file.state
        if on and stored.since_start >= self._max_run:
            self._rests_until = stored.elapsed + self._max_run
        if (rest := self._rests_until - stored.elapsed) > 0:
            yield Diagnosis.of("max_run", self._actuator, max=self._max_run, rest=rest)
        if stored.day_volume >= self._max_volume:
            yield Diagnosis.of(
                "daily_volume", self._actuator, volume=stored.day_volume, limit=self._max_volume,
                again=stored.clears_in(self._max_volume),
            )


class PumpLimits:
    """Limits on time off, starts, run time, volume in 24 h, cistern level, frost and quiet hours.

    After the node starts, the pump first waits for the minimum time off, since it is unknown how
    long it has been off.
    """

    def __init__(self, site: Site, settings: PumpSettings, state_file: StateFile) -> None:
        self._site = site
        self._settings = settings
        self._state_file = state_file
        self._off_since = state_file.state.elapsed
        self._usage = UsageLimits(
            state_file, settings.max_run, settings.max_volume_per_day, "pump"
        )
        self._dry = False

    def switch(self, on: bool) -> None:
        """Count a start or a stop."""
        self._state_file.switch(on)
        if not on:
            self._off_since = self._state_file.state.elapsed

    def wait(self) -> tuple[float, str]:
        """Return the time until a pump that is off may start (s), and the reason."""
        now, starts = self._state_file.state.elapsed, self._state_file.state.starts
        min_off, allowed = self._settings.min_off, int(self._site.starts_per_hour)
        waits = [
            (0.0, ""),
            (min_off - (now - self._off_since), f"it must stay off for at least {min_off:g} s"),
        ]
        if len(starts) >= allowed:
            again = starts[-allowed] + _HOUR_S - now
            waits.append((again, f"it may start at most {allowed} times an hour"))
        return max(waits)

    def reasons(self, observed: Observation, on: bool) -> Iterator[Diagnosis]:
        """Yield the current reasons for keeping the pump off; must be called at every step.

        Args:
            observed: present observations.
            on: whether the pump is on.
        """
        settings = self._settings
        names = "command", "cistern_level", "roof_level", "frost"
        yield from find_unknown({name: getattr(observed, name) for name in names})
        if observed.speed is None:
            yield Diagnosis.of("drive_not_ready")
        if (level := observed.cistern_level) is not None:
            minimum = self._site.suction_level + settings.level_offset + self._dry * _HYSTERESIS
            self._dry = level <= minimum
            if self._dry:
                yield Diagnosis.of("cistern_low", level=level, min=minimum)
        if observed.frost:
            yield Diagnosis.of("frost")
        quiet = self._site.quiet
        if quiet is not None and quiet.quiet_at(observed.time_ns):
            yield Diagnosis.of("quiet_hours", until=f"{quiet.end_after(observed.time_ns):%H:%M}")
        yield from self._usage.reasons(on)


class Pulses:
    """Conversion of a command into a flow that the pump can deliver, continuously or in pulses.

    Below its minimum flow, a pump overheats; below its minimum speed, it delivers nothing. The
    minimum share is the larger of the two corresponding flows. A smaller command is delivered
    in pulses at the minimum share. A pulse is the volume that this share delivers in the minimum
    time on, or more if the pump may not start so often. The outstanding volume is the commanded
    volume minus the volume that the actual flow has delivered. A pulse begins when it is
    outstanding, and ends when nothing is outstanding. The pump therefore lags the command by at
    most a pulse, and exceeds it only by the flow of one step and the flow while the pump is coming
    to a standstill.

    An interlock sets the outstanding volume to 0, and so does a command that the pump can follow,
    so that the pump does not catch up on obsolete demand.

    Attributes:
        outstanding: commanded minus delivered volume (m3), at most two pulses; negative if the
            minimum time on delivered more than was commanded.
    """

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site = site
        self._settings = settings
        self.outstanding = self._wanted = self._pulse = 0.0

    def min_share(self, cistern_level: float) -> float:
        """Return the minimum share of the maximum flow that may be requested at a level (m)."""
        slowest = flow_at(self._site, self._settings.min_speed, cistern_level)
        return max(self._settings.min_flow, slowest / flow_at(self._site, 1.0, cistern_level))

    def min_pulse(self, cistern_level: float) -> float:
        """Return the volume that the minimum share delivers in the minimum time on (m3)."""
        flow = self.min_share(cistern_level) * flow_at(self._site, 1.0, cistern_level)
        return self._settings.min_on * flow

    def count(self, delivered: float, dt: float) -> None:
        """Subtract the volume delivered in dt (m3), and add the volume that `update` demanded."""
        volume, most = self.outstanding + self._wanted * dt - delivered, 2 * self._pulse
        self.outstanding = min(most, max(-most, volume))

    def clear(self) -> None:
        """Reset the outstanding volume and the demand."""
        self.outstanding = self._wanted = self._pulse = 0.0

    def update(self, command: float, cistern_level: float, on: bool) -> float:
        """Update the demand, and return the requested share of the maximum flow, 0 for off.

        Args:
            command: share of the maximum flow, 0 to 1.
            cistern_level: level of the cistern (m), from which the pump lifts the water.
            on: whether the pump is on.
        """
        minimum = self.min_share(cistern_level)
        if command >= minimum:
            self.clear()
            return command
        self._wanted = command * flow_at(self._site, 1.0, cistern_level)
        between_starts = self._wanted * _HOUR_S / self._site.starts_per_hour
        self._pulse = max(self.min_pulse(cistern_level), between_starts)
        due = self.outstanding > 0 if on else self.due_in == 0
        return minimum if command > 0 and due else 0.0

    @property
    def due_in(self) -> float:
        """Time until the next pulse (s), if the command, which is not 0, stays as it is."""
        return max(0.0, self._pulse - self.outstanding) / max(self._wanted, _LEAST_FLOW)


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
