"""A controller that runs as the user's own node: ``greenroof run --controller external``."""

from __future__ import annotations

from typing import ClassVar

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.parameter import Parameter
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.site.horizon import MAX_HORIZON
from greenroof_ros.site.site import Site


class External(Controller):
    """Placeholder for a node that the user runs; only the look-ahead of its controller is known.

    The node receives the forecasts of its graph, which cover ``horizon`` and have a single member.
    """

    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            "horizon", 0.0, "h", 0.0, MAX_HORIZON, "length of the forecasts for the node, in "
            "growing steps; 0 for forecasts of the next M ticks",
        ),
    )

    outlet: ClassVar[float] = 0.0
    """the node commands the outlet valve itself"""

    def __init__(self, site: Site, horizon: float) -> None:
        """Raise an error, because an external controller does not run in this package's processes.

        Raises:
            ConfigurationError: always.
        """
        raise ConfigurationError(
            "is a node that you run yourself, so only greenroof run can use it", key="controller",
            value="external",
        )
