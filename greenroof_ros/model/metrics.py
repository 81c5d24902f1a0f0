"""What a run is judged by, added up tick by tick."""

from __future__ import annotations

from dataclasses import dataclass

from greenroof_ros.model.plant import JOULES_PER_KWH, WATER_DENSITY, Flows, head_loss
from greenroof_ros.model.site import Site


@dataclass
class Metrics:
    """Sums over a run, in the paper's metric and as a water balance.

    Attributes:
        total_deviation_m3: sum over the ticks j = 0..N of |x_{j,2} - x2*| (Fig. 5).
        final_cistern_m3: the last x1.
        final_roof_m3: the last x2.
        pumped_m3: from the cistern to the roof.
        outflow_m3: from the cistern to the sewer.
        drainage_m3: off the roof.
        rain_m3: into both tanks.
        evapotranspiration_m3: off the roof.
        max_command: largest command applied (1).
        limited_steps: ticks in which a tank held less than was asked of it.
        pump_starts: how often the flow delivered went from 0 to more; one at tick 0 counts.
        energy_kwh: put into the water, the sum of rho g q L(x, q) tau with L of Eq. (3c) (kWh);
            what the pumps draw is this over their efficiency.
    """

    total_deviation_m3: float = 0.0
    final_cistern_m3: float = 0.0
    final_roof_m3: float = 0.0
    pumped_m3: float = 0.0
    outflow_m3: float = 0.0
    drainage_m3: float = 0.0
    rain_m3: float = 0.0
    evapotranspiration_m3: float = 0.0
    max_command: float = 0.0
    limited_steps: int = 0
    pump_starts: int = 0
    energy_kwh: float = 0.0

    def __post_init__(self) -> None:
        """Begin with pumps that stand still."""
        self._pumping = False  # no field: it is no result

    def observe(self, site: Site, x1: float, x2: float) -> None:
        """Take the state of a tick (m3), for each tick 0..N."""
        self.total_deviation_m3 += abs(x2 - site.x2_star)
        self.final_cistern_m3 = x1
        self.final_roof_m3 = x2

    def step(self, site: Site, command: float, precipitation: float, flows: Flows) -> None:
        """Take what happens between a tick and the next, for each tick 0..N-1, once observed.

        Args:
            site: the parameters of Table I.
            command: the command given (1); a pump driver makes of it what it can.
            precipitation: rain (m/s).
            flows: what moves (m3/s).
        """
        tau = site.tau
        self.pumped_m3 += tau * flows.pump
        self.outflow_m3 += tau * flows.outflow
        self.drainage_m3 += tau * flows.drainage
        self.rain_m3 += tau * precipitation * (site.a_in + site.a2)
        self.evapotranspiration_m3 += tau * flows.evapotranspiration
        self.max_command = max(self.max_command, command)
        self.limited_steps += flows.limited
        pumping = flows.pump > 0
        self.pump_starts += pumping and not self._pumping
        self._pumping = pumping
        if pumping:
            head = head_loss(site, self.final_cistern_m3, flows.pump)
            joules = WATER_DENSITY * site.g * flows.pump * head * tau
            self.energy_kwh += joules / JOULES_PER_KWH
