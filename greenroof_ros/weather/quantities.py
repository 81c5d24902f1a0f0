"""The quantities of weather and of roofs: their names, units and physical ranges."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import NamedTuple

from greenroof_ros.site.site import MAX_EVAPOTRANSPIRATION, MAX_RAIN

PRECIPITATION = "precipitation"
EVAPOTRANSPIRATION = "evapotranspiration"
RADIATION = "solar radiation"
TEMPERATURE = "temperature"
HUMIDITY = "relative humidity"
DEW_POINT = "dew point"
WIND = "wind speed"
PRESSURE = "station pressure"
OTHER_DEMAND = "other demand"

FOR_EVAPOTRANSPIRATION = (TEMPERATURE, DEW_POINT, WIND, PRESSURE)
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
    """This project's unit of a quantity, its physical range, and its kinds of units in files.

    The range includes the errors of sensors: a pyranometer has an offset of up to 15 W/m2 at night
    (ISO 9060, first class), a saturated humidity sensor shows up to 105 %, a level sensor and a
    flow meter have a zero error, and dew is negative evapotranspiration of up to 0.1 mm/h.
    """

    unit: str
    low: float
    high: float
    kinds: tuple[str, ...]
    """keys of the table of units"""


WEATHER = {
    PRECIPITATION: Quantity("mm/h", 0.0, MAX_RAIN, ("depth",)),
    EVAPOTRANSPIRATION: Quantity("mm/day", -2.5, MAX_EVAPOTRANSPIRATION, ("depth",)),
    TEMPERATURE: Quantity("degC", -90.0, 60.0, ("temperature",)),
    DEW_POINT: Quantity("degC", -90.0, 60.0, ("temperature",)),
    WIND: Quantity("km/h", 0.0, 500.0, ("speed",)),
    PRESSURE: Quantity("kPa", 50.0, 110.0, ("pressure",)),
    RADIATION: Quantity("W/m2", -15.0, 2000.0, ("power", "energy")),
    HUMIDITY: Quantity("%", 0.0, 105.0, ("percentage",)),
    OTHER_DEMAND: Quantity("l/h", 0.0, 1e5, ("water",)),
}
ROOF = {
    "minimum temperature": Quantity("degC", -90.0, 60.0, ("temperature",)),
    "maximum temperature": Quantity("degC", -90.0, 60.0, ("temperature",)),
    "runoff": Quantity("mm/h", -0.1, 2000.0, ("depth", "volume")),
    "pumped": Quantity("mm/h", -0.1, 2000.0, ("depth", "volume")),
    "level": Quantity("m", -0.1, 100.0, ("length",)),
}
"""the quantities of a roof"""
QUANTITIES = {**WEATHER, **ROOF}

# Number of each unit in one of this project's; of an amount, the number in an hour.
_UNITS = {
    "depth": {"mm": 1.0, "cm": 0.1, "in": 1 / 25.4, "l/m2": 1.0},
    "volume": {"l": 1.0, "m3": 0.001},
    "water": {"l": 1.0, "m3": 0.001},
    "energy": {"Wh/m2": 1.0, "kJ/m2": 3.6, "MJ/m2": 0.0036, "J/cm2": 0.36},
    "power": {"W/m2": 1.0, "kW/m2": 0.001},
    "temperature": {"degC": 1.0, "degF": 1.8, "K": 1.0},
    "speed": {"km/h": 1.0, "m/s": 1 / 3.6, "kn": 1 / 1.852, "mph": 1 / 1.609344},
    "pressure": {"kPa": 1.0, "hPa": 10.0, "mbar": 10.0, "inHg": 1 / 3.386389, "mmHg": 7.500617},
    "percentage": {"%": 1.0, "1": 0.01},
    "length": {"m": 1.0, "cm": 100.0, "mm": 1000.0},
}
# Amounts are totals in the interval of a row or, with "/" and a time, rates.
_AMOUNTS = "depth", "volume", "water", "energy"
COUNTER = "counter "
"""begins the unit of a running total, such as ``counter mm``; its differences are amounts"""
_HOURS = {"s": 1 / 3600, "min": 1 / 60, "h": 1.0, "day": 24.0}
_ZEROS = {"degF": 32.0, "K": 273.15}
# Other ways to write units.
_CHARACTERS = str.maketrans({"°": "deg", "º": "deg", "²": "2", "³": "3", "^": ""})
_SPELLINGS = {
    "C": "degC", "F": "degF", "Deg C": "degC", "deg C": "degC", "Deg F": "degF", "deg F": "degF",
    "inch": "in", "inches": "in", "kph": "km/h", "mp/h": "mph", "knots": "kn", "mb": "mbar",
    "L": "l", "meters/second": "m/s", "%RH": "%", "hpa": "hPa", "hour": "h", "hr": "h", "d": "day",
    "millimeter": "mm",
}
_FACTOR = re.compile(r"(0\.\d+|1/\d+) ", re.ASCII)


def known_units(quantity: str) -> list[str]:
    """Return the units that a column of a quantity may have."""
    names = [name for kind in QUANTITIES[quantity].kinds for name in _UNITS[kind]]
    if QUANTITIES[quantity].unit.startswith("mm/"):
        names[1:1] = ["mm/h", "mm/day"]
    return names


def find_unit(quantity: str, name: str, step_h: float, area: float) -> Unit:
    """Return the unit of a column.

    Args:
        quantity: quantity of the column.
        name: name of the unit, such as ``mm``, ``mm/h``, ``degF``, ``0.1 mm`` or ``counter mm``.
        step_h: interval of a row (h), to which an amount refers.
        area: area of the roof (m2), to which litres and m3 refer.

    Raises:
        ValueError: if the quantity does not have such a unit; the message names those that it has.
    """
    factor, plain = _simplify(name.removeprefix(COUNTER))
    our_hours = _HOURS.get(QUANTITIES[quantity].unit.rpartition("/")[2], 1.0)
    for kind in QUANTITIES[quantity].kinds:
        units, hours = _UNITS[kind], {"": 1.0}
        if kind in _AMOUNTS:
            hours = {**_HOURS, "": step_h}
        unit, _, time = (plain, "", "") if plain in units else plain.rpartition("/")
        is_known = unit in units and time in hours
        if is_known and (not name.startswith(COUNTER) or (kind in _AMOUNTS and not time)):
            per_ours = units[unit] * (area if kind == "volume" else 1.0) * hours[time] / our_hours
            return Unit(name, per_ours / factor, _ZEROS.get(unit, 0.0) / factor)
    raise ValueError(f"the unit of {quantity} must be one of {', '.join(known_units(quantity))}")


def _simplify(name: str) -> tuple[float, str]:
    """Return the factor and the usual spelling of a unit."""
    match = _FACTOR.match(name.strip())
    text = name.strip().removeprefix(match[0] if match else "").translate(_CHARACTERS)
    text = _SPELLINGS.get(text, "/".join(_SPELLINGS.get(part, part) for part in text.split("/")))
    return float(Fraction(match[1])) if match else 1.0, text
