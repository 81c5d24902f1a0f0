"""How far a fit is: the stages it has, and how much of the present one is done."""

from __future__ import annotations

from collections.abc import Callable

Tell = Callable[[str, float], None]
"""Is told what is being done, and the share of the fit that is done, 0 to 1; it never falls."""

TELLING, BEGINNING, SEARCH, TELLING_THERE, LAST_SEARCH = STAGES = (
    "what the record tells", "where to begin", "search", "what the record tells there",
    "last search",
)


class Stages:
    """Counts the simulations of a fit, stage by stage.

    How many a search needs nobody knows before it ends. So the stages are the steps of the share,
    and within one it grows by the simulations of the most that it can need; a search that needs
    fewer ends with a leap.
    """

    def __init__(self, tell: Tell) -> None:
        """Begin before the first stage.

        Args:
            tell: called with each stage and each simulation.
        """
        self._tell = tell
        self._simulations = 0

    def begin(self, stage: str, most: int) -> None:
        """Begin a stage.

        Args:
            stage: of :data:`STAGES`.
            most: simulations that it can need.
        """
        self._stage, self._most, self._before = stage, most, self._simulations
        self._say()

    def simulated(self) -> None:
        """Count a simulation."""
        self._simulations += 1
        self._say()

    def end(self) -> None:
        """Say that all is done."""
        self._tell("done", 1.0)

    def _say(self) -> None:
        number = STAGES.index(self._stage)
        within = min(1.0, (self._simulations - self._before) / self._most)
        self._tell(
            f"{number + 1} of {len(STAGES)}: {self._stage}, {self._simulations} simulations",
            (number + within) / len(STAGES),
        )
