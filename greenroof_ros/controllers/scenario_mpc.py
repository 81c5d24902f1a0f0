"""The predictive controller that plans ahead, for an ensemble of forecasts."""

from __future__ import annotations

from typing import ClassVar

from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.after_forecast import DAYS_AFTER
from greenroof_ros.controllers.objective import Ensemble
from greenroof_ros.controllers.planner import MAX_COMMAND, Planner
from greenroof_ros.controllers.protocol import HORIZON
from greenroof_ros.controllers.regret_budget import WAITING_BUDGET, WAITING_SHARE
from greenroof_ros.controllers.roof_observer import OBSERVER_TIME_CONSTANT
from greenroof_ros.model.site import Site

_HOUR_S = 3600.0


class ScenarioMpc(Planner):
    """Plans for the worst members of an ensemble; for a single forecast as ``planning_mpc``."""

    parameters: ClassVar[tuple[Parameter, ...]] = (
        HORIZON,
        DAYS_AFTER,
        MAX_COMMAND,
        Parameter("cvar_level", 0.8, "1", 0.0, 0.99, "level of the conditional value-at-risk: 0 "
                  "the mean of all members, 0.9 that of the worst tenth"),
        Parameter("recourse", 6.0, "h", 0.0, 48.0, "until then one plan serves all members; the "
                  "next forecast is there then"),
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
        cvar_level: float,
        recourse: float,
        observer_time_constant: float,
        waiting_budget: float,
        waiting_share: float,
    ) -> None:
        """Take the site and the parameters; :attr:`parameters` has their units and meanings."""
        super().__init__(
            site, horizon, days_after, max_command, observer_time_constant, waiting_budget,
            waiting_share, ensemble=Ensemble(cvar_level, recourse * _HOUR_S),
        )
