"""The limits of a live node's inputs, and the levels as inputs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from greenroof_ros.base.parameter import Parameter
from greenroof_ros.interface.topics import read_topics
from greenroof_ros.live.live_input import LiveInput
from greenroof_ros.live.pumping.input_rules import (
    LevelRule,
    cistern_bounds,
    expected_movements,
    roof_bounds,
)
from greenroof_ros.site.site import Site

RECOVERY = Parameter(
    "recovery_time", 10.0, "s", 0.0, 86400.0,
        "time for which a rejected input must satisfy all rules before it is used again",
)
_FROZEN_MOVEMENT = Parameter(
    "frozen_movement", 0.01, "", 1e-6, 10.0,
        "change that the pump should have caused before an unchanged level counts as frozen (m); "
        "must exceed the sensor's resolution",
)
_JUMP_TOLERANCE = Parameter(
    "jump_tolerance", 0.02, "", 1e-6, 10.0,
        "maximum difference between two values of a level beyond what water can cause (m); at "
        "least 10 times the standard deviation of the noise",
)


# The maximum age of every topic on which nodes act in a live graph.
LIMITS = {
    topic.name: Parameter(
        age.parameter, age.default, "s", 0.1, age.max, f"maximum age of {age.quantity}"
    )
    for topic in read_topics().values() if (age := topic.max_age) is not None
}


def live_parameters(topics: Iterable[str]) -> list[Parameter]:
    """Return the parameters of a live node that acts on the given topics."""
    limits = dict.fromkeys(LIMITS[topic] for topic in topics)
    of_levels = [_FROZEN_MOVEMENT, _JUMP_TOLERANCE] if LIMITS["/roof/level"] in limits else []
    return [*limits, RECOVERY, *of_levels]


class Levels:
    """Levels of the cistern and the roof as inputs, with checks for physically possible changes.

    Attributes:
        cistern: the cistern's level.
        roof: the roof's level.
    """

    def __init__(
        self, site: Site, values: Mapping[str, Any], subscribe: Callable[..., LiveInput], *,
        needs_roof: bool = True,
    ) -> None:
        """Open both inputs.

        Args:
            site: site to which the tanks belong.
            values: values of the node's :func:`live_parameters`.
            subscribe: function that opens an input:
                :meth:`greenroof_ros.live.node.LiveNode.subscribe`.
            needs_roof: whether the node does not act without the level of the roof.
        """
        self._site, self._frozen_movement = site, values[_FROZEN_MOVEMENT.name]
        self._rules = [
            LevelRule(bounds, self._frozen_movement, values[_JUMP_TOLERANCE.name])
            for bounds in (cistern_bounds(site), roof_bounds(site))
        ]
        self.cistern = subscribe("/cistern/level", level=self._rules[0])
        self.roof = subscribe(
            "/roof/level", optional=not needs_roof, level=self._rules[1]
        )

    @property
    def displacements(self) -> tuple[float, float]:
        """Total displacements of both levels' readings by impossible jumps so far (m)."""
        cistern, roof = self._rules
        return cistern.displacement, roof.displacement

    def expect(self, flow: float) -> None:
        """Set the level changes that the pump's flow (m3/s) must cause in a tick.

        A coarse sensor may be off by half of the movement beyond which a level is frozen.
        """
        movements = expected_movements(
            self._site, flow, self.cistern.value, self.roof.value, self._frozen_movement / 2
        )
        for rule, movement in zip(self._rules, movements, strict=True):
            rule.expect(movement * self._site.tau)

