"""The site file of a fitted roof: the original site file with the fitted values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from greenroof_ros.analysis.calibration.fit import FILLED, Fit
from greenroof_ros.analysis.calibration.percolation import EXPONENT
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.file import format_site, read_site

CROP_NOTE = (
    "applies only if evapotranspiration is computed (fao56; hargreaves in calibrate), not if a "
    "weather file contains it"
)
"""where a crop coefficient has an effect"""
INTERVAL_NOTE = (
    "The intervals include the effect of parameters that the record cannot identify and that may "
    "have any value within their ranges. All other parameters have the values from the original "
    "site file."
)
"""what the intervals of fitted parameters cover"""

_ROOF = (
    "field_capacity", "wilting_point", "depletion_fraction", "drainage_storage", "drainage_time",
    "crop_coefficient",
)


Entries = dict[str, tuple[float, str]]
"""entries for a site file: by name a value, and the words that follow its unit"""


def list_fit_entries(fit: Fit, target: float) -> Entries:
    """Return the entries of a fit, each with its interval, or the reason why it is not identified.

    Args:
        fit: result of the fit.
        target: target depth on the roof (m) in the original site file.
    """
    entries: Entries = {name: (getattr(fit.site, name), "unchanged, not fitted") for name in _ROOF}
    for parameter in fit.parameters:
        reason = f"unchanged: {parameter.reason}"
        if parameter.interval:
            interval = f"fitted, {parameter.interval}"
            if parameter.name != EXPONENT:
                interval += " (95 %)"
            reason = f"{interval}; {parameter.reason}" if parameter.reason else interval
        if parameter.name == "crop_coefficient":
            reason += f"; {CROP_NOTE}"
        if parameter.name != FILLED:
            entries[parameter.name] = parameter.value, reason
    if fit.site.z_veg != target:
        entries["z_veg"] = fit.site.z_veg, "choose your own"
    return entries


def format_fitted_site(file: Path, entries: Entries, heading: Sequence[str]) -> str:
    """Return the text of a complete site file with fitted values.

    Args:
        file: path of the original site file.
        entries: entries of the fit.
        heading: comment lines for the top of the file.

    Raises:
        ConfigurationError: if the result is not a valid site, because a value is out of range.
    """
    fitted = {name: float(f"{value:.6g}") for name, (value, _) in entries.items()}
    try:
        site = read_site(file, fitted)
    except ConfigurationError as error:
        raise ConfigurationError(
            f"the fitted values do not form a valid site, so no file was written: {error.wrong}",
            file=file,
        ) from error
    text = format_site(site, {name: reason for name, (_, reason) in entries.items()})
    return "\n".join([*(f"# {line}" for line in heading), "", text])
