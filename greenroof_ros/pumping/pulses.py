"""From a command to a share of the flow that the pump can deliver: at length, or in pulses.

Below its least flow a pump gets too warm, and below its least speed it delivers nothing. A command
below both is delivered in pulses at the least share. A least pulse is what the least share delivers
in the least time on. A pulse begins when a least pulse will be owed by its end, and ends when
nothing is owed any more: less is delivered than was commanded by at most one least pulse, and more
only by what flows in a step and while the pump comes to rest. What is owed is what was commanded
less what was delivered, by the actual flow.

What may be owed is limited, so that nothing is caught up that nobody waits for:

- after a stop for any other reason than a command of 0 nothing is owed;
- while the command is 0, or at least the least share, at most one least pulse;
- below it at most what the least share delivers from one permitted start to the next, or a least
  pulse if that is more: with 20 starts an hour that of 180 s.
"""

from __future__ import annotations

from greenroof_ros.model.pump_speed import flow_at, speed_for
from greenroof_ros.model.site import Site
from greenroof_ros.pumping.settings import PumpSettings

# Time in which a pump that runs at length makes up for what is owed (s).
_CATCH_UP = 60.0


class Pulses:
    """Accounts what is owed, and decides the share that is asked for.

    Attributes:
        owed: commanded less delivered (m3), within its limits; negative after the least time on
            delivered more than was commanded.
    """

    def __init__(self, site: Site, settings: PumpSettings) -> None:
        self._site = site
        self._settings = settings
        self._spacing = 3600.0 / settings.starts_per_hour
        self._wanted = 0.0
        self._most_owed = 0.0
        self.owed = 0.0

    def least_share(self, cistern_level: float) -> float:
        """Return the least share of the maximum flow that is asked for at a level (m)."""
        return max(self._settings.least_flow, self._share_at_least_speed(cistern_level))

    def least_pulse(self, cistern_level: float) -> float:
        """Return what the least share delivers in the least time on (m3)."""
        return self._settings.least_on * self._flow(self.least_share(cistern_level), cistern_level)

    def speed(self, share: float, cistern_level: float) -> float:
        """Return the speed for a share of the flow, between the drive's least speed and 1."""
        speed = speed_for(self._site, share, cistern_level)
        return min(1.0, max(self._settings.least_speed, speed))

    def account(self, delivered: float, dt: float) -> None:
        """Count what was delivered (m3) in dt (s) against what :meth:`ask` was told before."""
        owed = self.owed + self._wanted * dt - delivered
        self.owed = min(self._most_owed, max(-self._most_owed, owed))

    def drop(self) -> None:
        """Forget what is owed, and that anything is wanted."""
        self._wanted = self._most_owed = self.owed = 0.0

    def ask(self, command: float, cistern_level: float, on: bool, since_start: float) -> float:
        """Return the share of the maximum flow to ask for; 0 is off.

        Args:
            command: share of the maximum flow, 0 to 1.
            cistern_level: m, where the pump lifts water.
            on: whether the pump is on.
            since_start: time since the pump was last started (s).
        """
        least = self.least_share(cistern_level)
        pulse = self.least_pulse(cistern_level)
        self._wanted = self._flow(command, cistern_level)
        if 0 < command < least:
            self._most_owed = max(pulse, self._spacing * self._flow(least, cistern_level))
        else:
            self._most_owed = pulse
        self.owed = min(self._most_owed, max(-self._most_owed, self.owed))
        if command >= least:
            catch_up = self.owed / _CATCH_UP / self._flow(1.0, cistern_level)
            return min(1.0, max(least, command + catch_up))
        if on:
            return least if command > 0 and self.owed > 0 else 0.0
        by_its_end = self.owed + self._settings.least_on * self._wanted
        due = command > 0 and self.owed > 0 and by_its_end >= pulse
        return least if due and since_start >= self._spacing else 0.0

    def _share_at_least_speed(self, cistern_level: float) -> float:
        slowest = flow_at(self._site, self._settings.least_speed, cistern_level)
        return slowest / self._flow(1.0, cistern_level)

    def _flow(self, share: float, cistern_level: float) -> float:
        return share * flow_at(self._site, 1.0, cistern_level)
