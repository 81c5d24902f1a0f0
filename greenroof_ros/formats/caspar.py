"""Archives of CaSPAr, the Canadian Surface Prediction Archive, as NetCDF.

A file is an issue, ``YYYYMMDDHH.nc``, or a member of an ensemble's issue, ``YYYYMMDDHH_EEE.nc``, in
which 000 is the control run (CaSPAr wiki, "CaSPAr file naming convention and variables"). It is
NetCDF with the conventions CF-1.6, and has a variable such as ``HRDPS_P_PR_SFC`` (time, rlat, rlon)
in m: precipitation since the beginning of the forecast; its ``time`` is hours since then. The
variables of standard name ``latitude`` and ``longitude`` give the place of each grid point.

The grid point nearest to the site is used. The rain of an hour is the difference of two sums; if
they are three or six hours apart, the rain is spread evenly over the hours between.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from greenroof_ros.common.errors import ConfigurationError, in_extra
from greenroof_ros.common.files import refuse_large
from greenroof_ros.formats.records import (
    PRECIPITATION,
    QUANTITIES,
    Archive,
    Issue,
    ensemble,
    gaps,
    mended,
)
from greenroof_ros.model.site import Site

if TYPE_CHECKING:
    from netCDF4 import Dataset, Variable

# Hours after the nominal time by which a run is complete, rounded up: HRDPS 4.9 h, GDPS 5.6 h
# (wethr.net, Weather Model Update Schedule). RDPS has no figure there; HRDPS, which begins from it
# and has its boundaries, is complete later. Nor have these ensembles; GEFS has 6.1 h.
_DELAYS_H = {
    "HRDPS": 5.0, "RDPS": 5.0, "GDPS": 6.0, "REPS": 7.0, "GEPS": 7.0, "GEPS_NA": 7.0,
}

_MAGIC = (b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"CDF\x02", b"CDF\x05")
_NAME = re.compile(r"([0-9]{10})(?:_([0-9]{3}))?(?: ?\([0-9]+\))?")  # a browser adds " (1)"
_VARIABLE = re.compile(rf"({'|'.join(_DELAYS_H)})_P_PR0?_SFC")
# Largest distance from the site to the nearest point: the coarsest grid has half a degree.
_FURTHEST_DEG = 0.5
# Longest time between two sums (h), in GEPS beyond eight days.
_LONGEST_STEP = 6
# Below and above all coordinates (degrees) and sums (m), and codes for missing values.
_CODES = (-900.0, 1e15)
# Largest decrease of a sum by rounding (mm); 2e-9 mm was seen in HRDPS.
_ROUNDING_MM = 0.05


def recognises(file: Path, head: bytes, /) -> bool:
    """Return whether a file is NetCDF by its first bytes or its name."""
    return head.startswith(_MAGIC) or file.suffix == ".nc"


def read_archive(files: Sequence[Path], site: Site, /) -> Archive:
    """Read files, each an issue or a member of one.

    Args:
        files: at least one, all of one product.
        site: its place on earth.

    Raises:
        ConfigurationError: a file is broken or not from CaSPAr, no point is near the site, an issue
            lacks members, or the library that reads NetCDF is not installed.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError(
            "needs latitude and longitude in the site file, to take the nearest point of the grid",
            file=files[0],
        )
    members = [_read(file, site.latitude, site.longitude) for file in files]
    product = members[0][2]
    by_issue: dict[datetime, list[tuple[int, Issue]]] = {}
    for issue, number, own in members:
        by_issue.setdefault(issue.issued, []).append((number, issue))
        if own != product:
            raise ConfigurationError(
                f"must be of {product}, as {files[0].name} is, not of {own}", file=issue.file
            )
    issues = [mended(ensemble(by_issue[issued])) for issued in sorted(by_issue)]
    return Archive(files[0], f"CaSPAr, {product}", issues, _DELAYS_H[product], issues)


def _read(file: Path, latitude: float, longitude: float) -> tuple[Issue, int, str]:
    """Return a file's member at the point nearest to a place (degrees), its number and product."""
    with in_extra("netcdf"):
        from netCDF4 import Dataset
    match = _NAME.fullmatch(file.stem)
    try:
        issued = datetime.strptime(f"{match and match[1]} +0000", "%Y%m%d%H %z")
    except ValueError:
        raise ConfigurationError(
            "must be named as in CaSPAr, YYYYMMDDHH.nc or YYYYMMDDHH_EEE.nc", file=file
        ) from None
    assert match is not None
    try:
        with Dataset(file) as dataset:
            variable, product = _variable(dataset)
            row, column = _nearest(dataset, variable, latitude, longitude)
            sums = 1000 * _numbers(variable[:, row, column])
            rain, missing = _rain(variable.name, _leads(dataset["time"], issued), sums)
    except ConfigurationError as error:
        raise ConfigurationError(error.wrong, file=file) from None
    # Errors of the library or numpy for absent or non-numeric data; a damaged file can be opened.
    except (OSError, RuntimeError, LookupError, TypeError, ValueError) as error:
        raise ConfigurationError(f"is not readable NetCDF: {error}", file=file) from error
    notes = tuple(
        f"{file.name}: the sum {lead} h after the issue is missing, and lies between its neighbours"
        for lead in missing
    )
    return Issue(issued, file, None, rain[None, :], notes=notes), int(match[2] or 0), product


def _variable(dataset: Dataset) -> tuple[Variable[Any], str]:
    """Return the variable of precipitation, and its product."""
    matches = [match for name in dataset.variables if (match := _VARIABLE.fullmatch(name))]
    if len(matches) != 1:
        raise ConfigurationError(
            f"must have one variable of precipitation, such as HRDPS_P_PR_SFC, of one of "
            f"{', '.join(_DELAYS_H)}; it has {', '.join(dataset.variables)}"
        )
    variable = dataset[matches[0][0]]
    _check_units(variable, "m", "for the sum since the issue")
    return variable, matches[0][1]


def _check_units(variable: Variable[Any], expected: str, why: str) -> None:
    units = getattr(variable, "units", "")
    if units != expected:
        raise ConfigurationError(
            f"must be '{expected}', {why}", key=f"{variable.name}:units", value=str(units)
        )


def _leads(time: Variable[Any], issued: datetime) -> NDArray[np.int64]:
    """Return 0 and the leads of a file's times (h)."""
    _check_units(time, f"hours since {issued:%Y-%m-%d %H:%M:%S}", "as in the file's name")
    times = _numbers(time[:])
    leads = np.concatenate(([0.0], times[1:] if times[0] == 0 else times))
    if len(leads) == 1 or not np.isin(np.diff(leads), np.arange(1, _LONGEST_STEP + 1)).all():
        raise ConfigurationError(
            f"must have more hours, each 1 to {_LONGEST_STEP} after the one before, not "
            f"{', '.join(f'{lead:g}' for lead in leads)}", key="time",
        )
    return leads.astype(np.int64)


def _nearest(
    dataset: Dataset, variable: Variable[Any], latitude: float, longitude: float
) -> tuple[int, int]:
    """Return the indices of the grid point nearest to a place.

    The distance is the great-circle angle, by the haversine.
    """
    coordinates = []
    for name in ("latitude", "longitude"):
        coordinates += dataset.get_variables_by_attributes(standard_name=name)[:1]
        if not coordinates or coordinates[-1].standard_name != name:
            raise ConfigurationError(f"must have a variable of standard_name '{name}'")
    north, east = (coordinate.dimensions for coordinate in coordinates)
    axes = ("time", *(north if north == east else (*north, *east)))
    if len(axes) != 3 or variable.dimensions != axes or dataset["time"].dimensions != ("time",):
        raise ConfigurationError(
            f"must have the dimensions time and the two of latitude ({', '.join(north)})"
            f" and longitude ({', '.join(east)}), not ({', '.join(variable.dimensions)}) "
            f"with times of ({', '.join(dataset['time'].dimensions)})", value=variable.name,
        )
    refuse_large(Path(dataset.filepath()), 8 * sum(part.size for part in coordinates))
    latitudes, longitudes = (_numbers(coordinate[:]) for coordinate in coordinates)
    if latitudes.ndim == 1:  # an axis; broadcast with the other it gives the grid
        latitudes = latitudes[:, np.newaxis]
    here, there = np.radians(latitude), np.radians(latitudes)
    apart = np.radians(longitudes - longitude)
    haversine = (
        np.sin((there - here) / 2) ** 2 + np.cos(here) * np.cos(there) * np.sin(apart / 2) ** 2
    )
    nearest = int(np.argmin(haversine))
    degrees = float(np.degrees(2 * np.arcsin(np.sqrt(haversine.flat[nearest]))))
    if not degrees <= _FURTHEST_DEG:
        raise ConfigurationError(
            f"has no point within {_FURTHEST_DEG:g} degrees of the site's place, {latitude:g}, "
            f"{longitude:g}; the nearest is {degrees:.3g} away"
        )
    row, column = np.unravel_index(nearest, haversine.shape)
    return int(row), int(column)


def _numbers(values: Any) -> NDArray[np.float64]:
    """Return values of a variable; NaN if missing, not finite, or a code such as -9999."""
    numbers: NDArray[np.float64] = np.ma.filled(values.astype(np.float64), np.nan)
    return np.where((numbers > _CODES[0]) & (numbers < _CODES[1]), numbers, np.nan)


def _rain(
    name: str, leads: NDArray[np.int64], sums: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[int]]:
    """Return the rain of each hour (mm/h) from its sums since the issue (mm).

    A missing sum between two others is interpolated; the leads of such sums are returned, too.

    Args:
        name: of the variable.
        leads: 0, and the sums' leads (h), shape (n + 1,).
        sums: at each time of the file. The sum of lead 0 can be missing, and is then 0; the last
            sums can be missing too.
    """
    sums = np.concatenate(([0.0], sums[len(sums) - len(leads) + 1 :]))
    known = np.flatnonzero(~np.isnan(sums))[-1] + 1
    single = [low for low, high in gaps(np.isnan(sums[:known])) if high - low == 1]
    for at in single:
        sums[at] = np.interp(leads[at], leads[[at - 1, at + 1]], sums[[at - 1, at + 1]])
    if known == 1 or np.isnan(sums[:known]).any():
        raise ConfigurationError(
            f"is missing {leads[np.argmax(np.isnan(sums))]} h after the issue", key=name
        )
    steps = np.diff(leads[:known])
    rain = np.diff(sums[:known]) / steps
    _, low, high = QUANTITIES[PRECIPITATION]
    wrong = np.flatnonzero(~((rain * steps >= -_ROUNDING_MM) & (rain <= high)))
    if wrong.size:
        raise ConfigurationError(
            f"must be the sum since the issue; it gives {rain[wrong[0]]:.4g} mm/h before hour "
            f"{leads[wrong[0] + 1]}, outside {low:g} to {high:g}", key=name
        )
    return np.repeat(np.maximum(rain, 0.0), steps), leads[single].tolist()
