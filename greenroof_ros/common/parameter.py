"""What a user sets: the one place for its default, unit, range and meaning."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Parameter:
    """A value that a user sets: of a controller, of the pump's limits, or of a node.

    From it come the node's declared parameter and its ``--help``, the check of a parameter file and
    of a study's grid, the command line's option and the table in the documentation.

    Attributes:
        name: lower case, with underscores.
        default: its value unless given; it gives the type: a number, a whole number, true or false,
            a text, or a list of texts.
        unit: of the value, ``1`` if it has none; empty where the meaning says it.
        low: least value of a number.
        high: largest value.
        meaning: one line, without the unit.
        may_change: whether it may change during a run; a controller then has an attribute of
            that name, which is set between two ticks.
        among: the texts that it may be, where they are few.
        measured: its default on a roof with a measured soil, where that is another.
    """

    name: str
    default: Any
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    meaning: str = ""
    may_change: bool = False
    among: tuple[str, ...] = ()
    measured: Any = None

    @property
    def whole(self) -> bool:
        """Whether it is a whole number."""
        return isinstance(self.default, int)

    @property
    def description(self) -> str:
        """Its meaning, with the unit."""
        return f"{self.meaning} ({self.unit})" if self.unit else self.meaning

    @property
    def limits(self) -> str:
        """Its range, or the texts that it may be; empty where there is no limit."""
        if math.isinf(self.low):
            return " or ".join(self.among)
        return f"{self.low} to {self.high}" if self.whole else f"{self.low:g} to {self.high:g}"

    @property
    def expected(self) -> str:
        """What a number must be, for messages."""
        kind = "a whole number " if self.whole else ""
        return f"must be {kind}from {self.low:g} to {self.high:g}"

    def accepts(self, value: float) -> bool:
        """Whether a number is in the range, and whole where it must be."""
        return self.low <= value <= self.high and not (self.whole and value % 1)
