"""The quantities of records in all file formats: their names, units and plausible values."""

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
"""the quantities from which evapotranspiration is computed if a file lacks it"""


class Unit(NamedTuple):
    """The unit of a file, relative to this project's: value in file = ours * per_ours + zero."""

    name: str
    """name of the unit in the file"""
    per_ours: float = 1.0
    """number of file units per unit of this project; 10 for hPa if ours is kPa"""
    zero: float = 0.0
    """value in the file for 0 in this project's unit; 32 for degF"""


class Quantity(NamedTuple):
    """This project's unit of a quantity, its plausible range, and the units allowed in a column."""

    unit: str
    low: float
    high: float
    nearly: float = 0.0
    """Tolerance around the range, within which a value is set to the nearest limit.

    The rounding and interpolation of models can lead to negative values, such as rain of -0.1 mm
    and radiation of -0.3 W/m2. A pyranometer has an offset of up to 15 W/m2 at night (ISO 9060,
    first class). Dew is negative evapotranspiration of up to about 0.1 mm/h. A humidity sensor has
    an error of up to 5 %, and a flow meter has a zero error.
    """
    units: tuple[str, ...] = ()
    """additional units that a column in this project's CSV format may have"""

    @property
    def is_water(self) -> bool:
        """Whether the quantity is a depth of water per time."""
        return self.unit.startswith("mm/")

    @property
    def columns(self) -> tuple[str, ...]:
        """All units that a column in this project's CSV format may have."""
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
"""the quantities of a roof; all others are quantities of weather"""

# The maximum amount of water in rows shorter than an hour (mm/h): 31.2 mm fell in a minute at
# Unionville in 1956 (WMO).
_MAX_SHORT_WATER = 1900.0
# How many of a unit make one of ours, for units that are not amounts of water.
_PER_OURS = {"cm": 100.0, "mm": 1000.0, "%": 100.0, "1": 0.01, "m/s": 1 / 3.6}
_HOURS = {"s": 1 / 3600, "h": 1.0, "day": 24.0}


def find_plausible(quantity: str, step_h: float, unit: Unit) -> Quantity:
    """Return a quantity with its plausible range for rows of a given duration (h).

    In short rows, the rate of rain can be higher, and the error of a row's total corresponds to a
    higher rate.
    """
    found = QUANTITIES[quantity]
    if step_h < 1 and is_amount(quantity, unit):
        found = found._replace(nearly=found.nearly / step_h)
    if step_h < 1 and found.unit == "mm/h":
        found = found._replace(high=_MAX_SHORT_WATER)
    return found


def is_amount(quantity: str, unit: Unit) -> bool:
    """Return True if a unit of water denotes the total over a row instead of a rate."""
    return QUANTITIES[quantity].is_water and "/" not in unit.name


def find_unit(quantity: str, name: str, step_h: float, area: float) -> Unit:
    """Return the unit of a column in this project's CSV format.

    Args:
        quantity: quantity of the column.
        name: name of the unit, one of the quantity's :attr:`Quantity.columns`.
        step_h: interval between rows (h), to which a total in a unit without ``/`` refers.
        area: area of the roof (m2), to which litres and m3 refer.
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
