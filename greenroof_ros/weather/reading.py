"""Weather files: which format one has, and what is made of it."""

from __future__ import annotations

from pathlib import Path

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import read_text
from greenroof_ros.model.site import Site
from greenroof_ros.weather import eccc, own_csv
from greenroof_ros.weather.evapotranspiration import FAO56, fao56
from greenroof_ros.weather.records import (
    EVAPOTRANSPIRATION,
    PRECIPITATION,
    fill_gaps,
)
from greenroof_ros.weather.series import Weather

# At and below this temperature there is frost: nothing is pumped (degC).
_FREEZING = 0.0


def read_weather(path: Path, site: Site, method: str | None = None) -> Weather:
    """Read a weather file: of this project's form, or an hourly bulk file of ECCC.

    Gaps of at most :data:`greenroof_ros.weather.records.LONGEST_GAP` hours are filled and noted in
    the records; a run that needs an hour of a longer one is refused by :class:`WeatherSeries`.

    Args:
        path: the file.
        site: its place on earth, where evapotranspiration is computed or the file is ECCC's.
        method: of the evapotranspiration: ``fao56``, or that of the file's own column. The
            latter if there is one and otherwise ``fao56``, unless given.

    Raises:
        ConfigurationError: the file is broken, or cannot give the method.
    """
    text = read_text(path, byte_order_mark=True)
    if eccc.is_eccc(text):
        records = fill_gaps(eccc.parse(path, text, site))
    else:
        records = own_csv.parse(path, read_text(path))
    frost = None
    if "temperature" in records.values:
        frost = records.values["temperature"] <= _FREEZING
    if EVAPOTRANSPIRATION in records.values and method in (None, records.method):
        evapotranspiration, method = records.values[EVAPOTRANSPIRATION], records.method
    elif method in (None, FAO56):
        evapotranspiration, method = fao56(records, site), FAO56
    else:
        own = f", or {records.method} from its own column" if records.method else ""
        raise ConfigurationError(
            f"must be {FAO56}{own}: {path} has no evapotranspiration of another name",
            key="evapotranspiration", value=method,
        )
    return Weather(records, records.values[PRECIPITATION], evapotranspiration, method, frost)
