"""The predictive controller that plans ahead, for one forecast."""

from __future__ import annotations

from typing import ClassVar

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.after_forecast import DAYS_AFTER
from greenroof_ros.controllers.objective import Prices
from greenroof_ros.controllers.planner import Planner
from greenroof_ros.controllers.protocol import HORIZON, MAX_COMMAND
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT
from greenroof_ros.model.site import Site


class PlanningMpc(Planner):
    """Plans for the least deviation, and prices of energy and pump starts if there are any."""

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON,
        DAYS_AFTER,
        MAX_COMMAND,
        Parameter("power", 1, "1", 1, 2, "of the deviation in the objective: 1 as the metric, 2 "
                  "squares it"),
        Parameter("energy_weight", 0.0, "m3 s/kWh", 0.0, 1e9, "what a kWh of hydraulic energy "
                  "counts as deviation; with power 2 as its square (m6 s/kWh)"),
        Parameter("start_weight", 0.0, "m3 s", 0.0, 1e4, "what a pump start at full flow counts, "
                  "likewise"),
        OBSERVER_TIME_CONSTANT,
        WAITING_BUDGET,
        WAITING_SHARE,
    )

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        max_command: float,
        power: float,
        energy_weight: float,
        start_weight: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Take the site and the parameters; :attr:`parameters` has their units and meanings."""
        super().__init__(
            site, horizon, days_after, max_command, observer_time_constant, waiting_budget,
            waiting_share, power=power, prices=Prices(energy_weight, start_weight),
        )
