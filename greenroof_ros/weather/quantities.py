"""The quantities of weather and of roofs: their names, units and physical ranges."""

from __future__ import annotations

import re
from typing import NamedTuple

PRECIPITATION = "precipitation"
EVAPOTRANSPIRATION = "evapotranspiration"
RADIATION = "solar radiation"
TEMPERATURE = "temperature"
HUMIDITY = "relative humidity"
DEW_POINT = "dew point"
WIND = "wind speed"
PRESSURE = "station pressure"

FOR_EVAPOTRANSPIRATION = (TEMPERATURE, DEW_POINT, WIND, PRESSURE)
"""the quantities from which evapotranspiration is computed if a file lacks it"""

MUCH_RAIN = 500.0
"""rain (mm/h) above which a note is printed: the record of an hour is 401 mm (Shangdu, China, 1975)
"""


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
    """keys of :data:`UNITS`"""


# More than 2,000 mm/h has never been measured: the record is 31.2 mm in a minute (Unionville, USA,
# 1956; WMO).
QUANTITIES: dict[str, Quantity] = {
    PRECIPITATION: Quantity("mm/h", 0.0, 2000.0, ("depth",)),
    EVAPOTRANSPIRATION: Quantity("mm/day", -2.5, 50.0, ("depth",)),
    TEMPERATURE: Quantity("degC", -90.0, 60.0, ("temperature",)),
    DEW_POINT: Quantity("degC", -90.0, 60.0, ("temperature",)),
    WIND: Quantity("km/h", 0.0, 500.0, ("speed",)),
    PRESSURE: Quantity("kPa", 50.0, 110.0, ("pressure",)),
    RADIATION: Quantity("W/m2", -15.0, 2000.0, ("power", "energy")),
    HUMIDITY: Quantity("%", 0.0, 105.0, ("share",)),
    "minimum temperature": Quantity("degC", -90.0, 60.0, ("temperature",)),
    "maximum temperature": Quantity("degC", -90.0, 60.0, ("temperature",)),
    "runoff": Quantity("mm/h", -0.1, 2000.0, ("depth", "volume")),
    "pumped": Quantity("mm/h", -0.1, 2000.0, ("depth", "volume")),
    "level": Quantity("m", -0.1, 100.0, ("length",)),
    "cistern level": Quantity("m", -0.1, 100.0, ("length",)),
    "pump state": Quantity("1", -0.02, 1.02, ("share",)),
}
ROOF = (
    "minimum temperature", "maximum temperature", "runoff", "pumped", "level", "cistern level",
    "pump state",
)
"""the quantities of a roof; all others are quantities of weather"""

# Number of each unit in one of the first unit of its kind, and the value at 0 of the first unit.
# Depths and volumes are amounts in the interval of a row or, with "/", rates.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "depth": {"mm": (1.0, 0.0), "cm": (0.1, 0.0), "in": (1 / 25.4, 0.0), "l/m2": (1.0, 0.0)},
    "volume": {"l": (1.0, 0.0), "m3": (0.001, 0.0)},
    "temperature": {"degC": (1.0, 0.0), "degF": (1.8, 32.0), "K": (1.0, 273.15)},
    "speed": {
        "km/h": (1.0, 0.0), "m/s": (1 / 3.6, 0.0), "kn": (1 / 1.852, 0.0),
        "mph": (1 / 1.609344, 0.0),
    },
    "pressure": {
        "kPa": (1.0, 0.0), "hPa": (10.0, 0.0), "mbar": (10.0, 0.0), "inHg": (1 / 3.386389, 0.0),
        "mmHg": (7.500617, 0.0),
    },
    "power": {"W/m2": (1.0, 0.0), "kW/m2": (0.001, 0.0)},
    "energy": {
        "Wh/m2": (1.0, 0.0), "kJ/m2": (3.6, 0.0), "MJ/m2": (0.0036, 0.0), "J/cm2": (0.36, 0.0),
    },
    "share": {"%": (100.0, 0.0), "1": (1.0, 0.0)},
    "length": {"m": (1.0, 0.0), "cm": (100.0, 0.0), "mm": (1000.0, 0.0)},
}
_AMOUNTS = "depth", "volume", "energy"
_HOURS = {"s": 1 / 3600, "min": 1 / 60, "h": 1.0, "day": 24.0}
# Other ways to write units.
_CHARACTERS = str.maketrans({"°": "deg", "º": "deg", "²": "2", "³": "3", "^": ""})
_SPELLINGS = {
    "C": "degC", "F": "degF", "Deg C": "degC", "deg C": "degC", "Deg F": "degF", "deg F": "degF",
    "inch": "in", "inches": "in", "kph": "km/h", "knots": "kn", "mb": "mbar", "hr": "h", "d": "day",
    "L": "l", "meters/second": "m/s", "%RH": "%", "hpa": "hPa", "hour": "h", "millimeter": "mm",
}
_FACTOR = re.compile(r"(0\.\d+|1/\d+) (.+)", re.ASCII)


def is_amount(quantity: str, unit: str) -> bool:
    """Return True if a unit denotes the total in the interval of a row instead of a rate."""
    amounts = [name for kind in _AMOUNTS for name in UNITS[kind]]
    return _simplify(unit)[1] in amounts and quantity not in ("level", "cistern level")


def known_units(quantity: str) -> list[str]:
    """Return the units that a column of a quantity may have."""
    names = [name for kind in QUANTITIES[quantity].kinds for name in UNITS[kind]]
    if QUANTITIES[quantity].unit.startswith("mm/"):
        names[1:1] = ["mm/h", "mm/day"]
    return names


def find_unit(quantity: str, name: str, step_h: float, area: float) -> Unit:
    """Return the unit of a column.

    Args:
        quantity: quantity of the column.
        name: name of the unit, such as ``mm``, ``mm/h``, ``degF`` or ``0.1 mm``.
        step_h: interval of a row (h), to which an amount refers.
        area: area of the roof (m2), to which litres and m3 refer.

    Raises:
        ValueError: if the quantity does not have such a unit.
    """
    factor, plain = _simplify(name)
    ours = QUANTITIES[quantity].unit
    for kind in QUANTITIES[quantity].kinds:
        units = UNITS[kind]
        if kind in ("depth", "volume"):
            amount, _, time = plain.partition("/") if plain not in units else (plain, "", "")
            if amount in units and time in ("", *_HOURS):
                hours = _HOURS[time] if time else step_h
                of_mm = units[amount][0] * (area if kind == "volume" else 1.0)
                return Unit(name, of_mm * hours / _HOURS[ours.partition("/")[2]] / factor)
        elif plain in units:
            per_first, zero = units[plain]
            hours = step_h if kind == "energy" else 1.0
            per_ours = per_first / units.get(ours, (1.0, 0.0))[0] * hours / factor
            return Unit(name, per_ours, zero / factor)
    raise ValueError


def _simplify(name: str) -> tuple[float, str]:
    """Return the factor and the usual spelling of a unit."""
    match = _FACTOR.fullmatch(name.strip())
    factor, text = (match[1], match[2]) if match else ("1", name.strip())
    text = text.translate(_CHARACTERS)
    text = _SPELLINGS.get(text, "/".join(_SPELLINGS.get(part, part) for part in text.split("/")))
    top, _, bottom = factor.partition("/")
    return float(top) / float(bottom or 1), text
