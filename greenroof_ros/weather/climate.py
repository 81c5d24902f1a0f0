"""Weather of another climate: a record with more or less rain, and warmer or colder."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from greenroof_ros.base.parameter import entry, parameters_of
from greenroof_ros.weather.evapotranspiration import saturation_vapour_pressure
from greenroof_ros.weather.quantities import DEW_POINT, PRECIPITATION, TEMPERATURE
from greenroof_ros.weather.records import Array, Records


@dataclass(frozen=True)
class Climate:
    """How the climate of a run differs from that of its record."""

    rain_factor: float = entry(
        "factor by which all rain of the record is multiplied, for another climate", 0.0, 10.0, unit="1", default=1.0,
    )
    temperature_change: float = entry(
        "difference that is added to all temperatures of the record; the relative humidity stays",
        -20.0, 20.0, unit="K", default=0.0,
    )

    def __str__(self) -> str:
        """Return the differences in words; empty without any."""
        return ", ".join([
            *([f"rain times {self.rain_factor:g}"] if self.rain_factor != 1 else []),
            *([f"temperature {self.temperature_change:+g} K"] if self.temperature_change else []),
        ])

    def changed(self) -> dict[str, float]:
        """Return the values that differ from those of an unchanged record, by name."""
        return {name: value for name, value in asdict(self).items()
                if value != getattr(RECORDED, name)}


RECORDED = Climate()
"""the climate of the record"""
CLIMATE = {parameter.name: parameter for parameter in parameters_of(Climate)}
"""the inputs of a run that change its climate, by name"""


def change_climate(records: Records, climate: Climate) -> Records:
    """Return records in another climate.

    All rain is multiplied, so that wet and dry hours stay. The dew point follows the temperature,
    so that the relative humidity stays, as most projections assume.
    """
    if climate == RECORDED:
        return records
    values = {**records.values, PRECIPITATION: climate.rain_factor * records.values[PRECIPITATION]}
    if climate.temperature_change and TEMPERATURE in values:
        before = values[TEMPERATURE]
        values[TEMPERATURE] = before + climate.temperature_change
        if DEW_POINT in values:
            growth = saturation_vapour_pressure(values[TEMPERATURE]) / (
                saturation_vapour_pressure(before)
            )
            values[DEW_POINT] = _find_dew_point(
                growth * saturation_vapour_pressure(values[DEW_POINT])
            )
    minutes = records.minutes
    return replace(
        records, values=values, minutes=None if minutes is None else climate.rain_factor * minutes
    )


def _find_dew_point(pressure: Array) -> Array:
    """Return the dew point (degC) at a vapour pressure (kPa), the inverse of FAO-56 Eq. 11."""
    exponent = np.log(pressure / 0.6108)
    return np.asarray(237.3 * exponent / (17.27 - exponent))

