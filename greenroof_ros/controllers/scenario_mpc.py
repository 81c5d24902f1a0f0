"""The predictive controller that plans ahead, for an ensemble of forecasts."""

from __future__ import annotations

from typing import ClassVar

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.after_forecast import DAYS_AFTER
from greenroof_ros.controllers.planner import Planner
from greenroof_ros.controllers.protocol import HORIZON, MAX_COMMAND
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT
from greenroof_ros.model.look_ahead import LONGEST_HORIZON
from greenroof_ros.model.site import Site

_HOUR_S = 3600.0


class ScenarioMpc(Planner):
    """Plans for all members of an ensemble; for a single forecast as ``planning_mpc``."""

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON,
        DAYS_AFTER,
        MAX_COMMAND,
        Parameter("recourse", 48.0, "h", 1.0, LONGEST_HORIZON, "until then one plan serves all "
                  "members; each time it has passed, newer forecasts tell which half of them was "
                  "wrong"),
        OBSERVER_TIME_CONSTANT,
        WAITING_BUDGET,
        WAITING_SHARE,
    )
    ensemble: ClassVar[bool] = True

    def __init__(
        self,
        site: Site,
        horizon: float,
        days_after: float,
        max_command: float,
        recourse: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Take the site and the parameters; :attr:`parameters` has their units and meanings."""
        super().__init__(
            site, horizon, days_after, max_command, observer_time_constant, waiting_budget,
            waiting_share, recourse=recourse * _HOUR_S,
        )
