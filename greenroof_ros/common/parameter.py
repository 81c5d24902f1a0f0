"""A parameter of a controller: the one place for its default, unit, range and meaning."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Parameter:
    """A number that a user sets.

    From it come the node's declared parameter, the check of a parameter file and of a study's
    grid, the command line's option and the table in the documentation. It is a whole number where
    its default is one.

    Attributes:
        name: lower case, with underscores.
        default: its value unless given.
        unit: of the value, ``1`` if it has none.
        low: least value.
        high: largest value.
        meaning: one line, without the unit.
        may_change: whether it may change during a run; the controller then has an attribute of
            that name, which is set between two ticks.
    """

    name: str
    default: float
    unit: str
    low: float
    high: float
    meaning: str
    may_change: bool = False

    @property
    def whole(self) -> bool:
        """Whether it is a whole number."""
        return isinstance(self.default, int)

    @property
    def expected(self) -> str:
        """What a value must be, for messages."""
        kind = "a whole number " if self.whole else ""
        return f"must be {kind}from {self.low:g} to {self.high:g}"

    def accepts(self, value: float) -> bool:
        """Whether a value is in the range, and whole where it must be."""
        return self.low <= value <= self.high and not (self.whole and value % 1)
