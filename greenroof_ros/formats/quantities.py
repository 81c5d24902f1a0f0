"""The quantities of records: names, units and plausible values, the same for every file format."""

from __future__ import annotations

from typing import NamedTuple

PRECIPITATION = "precipitation"
EVAPOTRANSPIRATION = "evapotranspiration"
RADIATION = "solar radiation"
TEMPERATURE = "temperature"
HUMIDITY = "relative humidity"
DEW_POINT = "dew point"
PRESSURE = "station pressure"

FOR_EVAPOTRANSPIRATION = (TEMPERATURE, DEW_POINT, "wind speed", PRESSURE)
"""the quantities from which evapotranspiration is computed, if it is not given"""


class Unit(NamedTuple):
    """A unit in a file, expressed in ours: theirs = ours * per_ours + zero."""

    name: str
    """name of the unit in the file"""
    per_ours: float = 1.0
    """how many of it make one of ours; 10 for hPa if ours is kPa"""
    zero: float = 0.0
    """its value where ours is 0; 32 for degF"""


class Quantity(NamedTuple):
    """Our unit of a quantity, the range of its plausible values, and the units of a column."""

    unit: str
    low: float
    high: float
    nearly: float = 0.0
    """How far outside its range a value may be to be moved to the end of the range.

    Models round, and interpolate below 0: rain of -0.1 mm and radiation of -0.3 W/m2 occur. A
    pyranometer has an offset of up to 15 W/m2 at night (ISO 9060, first class). Dew is negative
    evapotranspiration, of up to about 0.1 mm/h. A humidity sensor is off by up to 5 %, and a flow
    meter has a zero error.
    """
    units: tuple[str, ...] = ()
    """units of a column in this project's CSV, besides our own"""

    @property
    def is_water(self) -> bool:
        """Whether it is a depth of water per time."""
        return self.unit.startswith("mm/")

    @property
    def columns(self) -> tuple[str, ...]:
        """All units that a column in this project's CSV may have."""
        return self.unit, *self.units


_LENGTHS = ("cm", "mm")
_WATER = ("mm", "l", "l/s", "m3/h")

# A value above the world record of an hour's rain, or of a day's evapotranspiration, indicates a
# wrong unit. No roof returns more than its rain. The minimum level allows for a sensor's zero
# error.
QUANTITIES: dict[str, Quantity] = {
    PRECIPITATION: Quantity("mm/h", 0.0, 500.0, 0.5, ("mm",)),
    EVAPOTRANSPIRATION: Quantity("mm/day", 0.0, 50.0, 2.5, ("mm/h", "mm")),
    TEMPERATURE: Quantity("degC", -90.0, 60.0),
    DEW_POINT: Quantity("degC", -90.0, 60.0),
    "wind speed": Quantity("km/h", 0.0, 500.0, 1.0, ("m/s",)),
    "station pressure": Quantity("kPa", 50.0, 110.0),
    RADIATION: Quantity("W/m2", 0.0, 1500.0, 15.0),
    HUMIDITY: Quantity("%", 0.0, 100.0, 5.0, ("1",)),
    "minimum temperature": Quantity("degC", -90.0, 60.0),
    "maximum temperature": Quantity("degC", -90.0, 60.0),
    "runoff": Quantity("mm/h", 0.0, 500.0, 0.1, _WATER),
    "pumped": Quantity("mm/h", 0.0, 500.0, 0.1, _WATER),
    "level": Quantity("m", -0.1, 100.0, 0.0, _LENGTHS),
    "cistern level": Quantity("m", -0.1, 100.0, 0.0, _LENGTHS),
    "pump state": Quantity("1", 0.0, 1.0, 0.02, ("%",)),
}
ROOF = (
    "minimum temperature", "maximum temperature", "runoff", "pumped", "level", "cistern level",
    "pump state",
)
"""the quantities of a roof; the others are weather"""

# The maximum amount of water in rows shorter than an hour (mm/h): 31.2 mm fell in a minute at
# Unionville in 1956 (WMO).
_MAX_SHORT_WATER = 1900.0
# How many of a unit make one of ours, for units that are not amounts of water.
_PER_OURS = {"cm": 100.0, "mm": 1000.0, "%": 100.0, "1": 0.01, "m/s": 1 / 3.6}
_HOURS = {"s": 1 / 3600, "h": 1.0, "day": 24.0}


def find_plausible(quantity: str, step_h: float, unit: Unit) -> Quantity:
    """Return a quantity with its plausible values for rows that are a step (h) apart.

    In short rows, more rain can fall per hour, and the error of a row's sum is a larger rate.
    """
    found = QUANTITIES[quantity]
    if step_h < 1 and is_amount(quantity, unit):
        found = found._replace(nearly=found.nearly / step_h)
    if step_h < 1 and found.unit == "mm/h":
        found = found._replace(high=_MAX_SHORT_WATER)
    return found


def is_amount(quantity: str, unit: Unit) -> bool:
    """Return whether a unit of water is the sum over a row rather than a rate."""
    return QUANTITIES[quantity].is_water and "/" not in unit.name


def find_unit(quantity: str, name: str, step_h: float, area: float) -> Unit:
    """Return a unit of a column in this project's CSV.

    Args:
        quantity: quantity of the column.
        name: name of the unit, one of the quantity's :attr:`Quantity.columns`.
        step_h: time between rows (h), over which an amount without ``/`` is summed.
        area: area of the roof (m2), for litres and m3.
    """
    ours = QUANTITIES[quantity].unit
    if name == ours:
        return Unit(name)
    if not QUANTITIES[quantity].is_water:
        return Unit(name, _PER_OURS[name])
    amount, _, time = name.partition("/")
    of_mm = {"mm": 1.0, "l": area, "m3": area / 1000}[amount]
    hours = _HOURS[time] if time else step_h
    return Unit(name, of_mm * hours / _HOURS[ours.partition("/")[2]])
