"""Outputs of a weather node: the current weather, frost, and two forecasts."""

from __future__ import annotations

import math
from array import array
from datetime import datetime
from typing import Any

from greenroof_ros.ros.graph_node import GraphNode
from greenroof_ros.ros.messages import WithFront
from greenroof_ros.site.horizon import look_ahead_ends
from greenroof_ros.site.site import Site

FROST = "/weather/frost"
RAIN, EVAPOTRANSPIRATION = "/weather/precipitation", "/weather/evapotranspiration"
_FORECASTS = "/forecast/precipitation", "/forecast/evapotranspiration"


class WeatherOutputs:
    """Publisher of a weather node's outputs."""

    def __init__(
        self, node: GraphNode, site: Site, horizon: float, outlet_horizon: float = 0.0
    ) -> None:
        """Open the topics.

        Args:
            node: the node.
            site: the site.
            horizon: length of the forecasts (h); 0 for the next M ticks.
            outlet_horizon: length of the forecasts for planning the outlet valve (h); 0 if the
                valve is not planned.
        """
        self.publish = node.publish
        # Prefix of every forecast: the time of its issue (s since 1970), and the ends of its steps
        # (s from now).
        self._front = array("d", [math.nan, *look_ahead_ends(site, horizon, outlet_horizon)[1:]])
        node.open_outputs(FROST, RAIN, EVAPOTRANSPIRATION, *_FORECASTS)

    def publish_forecasts(self, issued: datetime | None, *forecasts: Any) -> None:
        """Publish the forecasts of rain and evapotranspiration, with their time of issue."""
        self._front[0] = math.nan if issued is None else issued.timestamp()
        for topic, forecast in zip(_FORECASTS, forecasts, strict=True):
            self.publish(topic, WithFront(self._front, forecast))
