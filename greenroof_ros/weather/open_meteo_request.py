"""What is requested from Open-Meteo, for past weather and for forecasts alike."""

from __future__ import annotations

from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.formats.open_meteo import VARIABLES
from greenroof_ros.site.site import Site

QUANTITIES = tuple(VARIABLES)
"""the quantities that every request names, in the service's variables"""


def make_parameters(site: Site, **more: str | float) -> dict[str, str | float]:
    """Return the parameters of a request for hours in UTC, in the service's default units.

    Args:
        site: site, including its location.
        more: parameters for the period or the model.

    Raises:
        ConfigurationError: if the site file lacks the location.
    """
    for name in ("latitude", "longitude"):
        if getattr(site, name) is None:
            raise ConfigurationError(
                "must be in the site file, because Open-Meteo's data are for a location", key=name
            )
    return {
        "latitude": float(site.latitude or 0), "longitude": float(site.longitude or 0),
        "hourly": ",".join(VARIABLES.values()), "timezone": "GMT", **more,
    }
