"""Archives of CaSPAr, the Canadian Surface Prediction Archive: HRDPS, REPS and GEPS as NetCDF.

A file is an issue, ``YYYYMMDDHH.nc``, and of an ensemble a member of it, ``YYYYMMDDHH_EEE.nc``, in
which 000 is the control run (CaSPAr wiki, "CaSPAr file naming convention and variables"). It is
NetCDF by the conventions CF-1.6, and has a variable ``HRDPS_P_PR_SFC`` (time, rlat, rlon) in m:
precipitation since the beginning of the forecast, its ``time`` the hours since then. The place is
given by the variables of standard name ``latitude`` and ``longitude``, of each point of the grid.

Taken is the point that is nearest to the site. The rain of an hour is the difference of two sums;
where they are further apart, three hours or six, each hour between has its share of it.
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
from greenroof_ros.formats.records import PRECIPITATION, QUANTITIES, Archive, Issue, ensemble
from greenroof_ros.model.site import Site

if TYPE_CHECKING:
    from netCDF4 import Dataset, Variable

# Hours after the nominal time by which a run is whole. HRDPS 4.9 h; of ensembles GEFS, for lack of
# figures of these, 6.1 h (wethr.net, Weather Model Update Schedule): rounded up to whole hours.
_DELAYS_H = {"HRDPS": 5.0, "REPS": 7.0, "GEPS": 7.0, "GEPS_NA": 7.0}

_MAGIC = (b"\x89HDF\r\n\x1a\n", b"CDF\x01", b"CDF\x02", b"CDF\x05")
_NAME = re.compile(r"([0-9]{10})(?:_([0-9]{3}))?")
_VARIABLE = re.compile(r"(\w+)_P_PR0?_SFC")
# What CaSPAr's numbers, which have 32 bits, can be.
_LARGEST = float(np.finfo(np.float32).max)
# By what values of NetCDF are unpacked and masked; where one is no number, the library leaves that
# out, or fails.
_PACKING = ("scale_factor", "add_offset", "valid_min", "valid_max")
# To where a coordinate can go (degrees); longitudes are to the east or to the west.
_ENDS = {"latitude": 90.0, "longitude": 360.0}
# How far the nearest point may be from the site: the coarsest of these grids has half a degree.
_FURTHEST_DEG = 0.5
# Sums are at most so far apart (h), in GEPS beyond eight days.
_LONGEST_STEP = 6
# By how much a sum may fall by rounding (mm); in HRDPS 2e-9 mm were seen.
_ROUNDING_MM = 0.05


def recognises(file: Path, head: bytes, /) -> bool:
    """Whether a file is NetCDF by its first bytes, or said to be by its name."""
    return head.startswith(_MAGIC) or file.suffix == ".nc"


def read_archive(files: Sequence[Path], site: Site, /) -> Archive:
    """Read files, each an issue or a member of one.

    Args:
        files: at least one, all of one product.
        site: its place on earth.

    Raises:
        ConfigurationError: a file is broken or not as CaSPAr's are, no point is near the site, an
            issue lacks members; or the library that reads NetCDF is not there.
    """
    if site.latitude is None or site.longitude is None:
        raise ConfigurationError(
            "needs latitude and longitude in the site file, to take the nearest point of the grid",
            file=files[0],
        )
    members = [_read(file, site.latitude, site.longitude) for file in files]
    product = members[0][2]
    by_issue: dict[datetime, list[tuple[int, Issue]]] = {}
    for issue, number, other in members:
        by_issue.setdefault(issue.issued, []).append((number, issue))
        if other != product:
            raise ConfigurationError(
                f"must be of {product}, as {files[0].name} is, not of {other}", file=issue.file
            )
    issues = [ensemble(by_issue[issued]) for issued in sorted(by_issue)]
    return Archive(files[0], f"CaSPAr, {product}", issues, _DELAYS_H[product], issues)


def _read(file: Path, latitude: float, longitude: float) -> tuple[Issue, int, str]:
    """Return a file's member at the point nearest to a place (degrees), its number and product."""
    with in_extra("netcdf"):
        from netCDF4 import Dataset
    try:
        match = _NAME.fullmatch(file.stem)
        issued = datetime.strptime(f"{match and match[1]} +0000", "%Y%m%d%H %z")
    except ValueError:
        raise ConfigurationError(
            "must be named as CaSPAr does, YYYYMMDDHH.nc or YYYYMMDDHH_EEE.nc", file=file
        ) from None
    assert match is not None
    try:
        with Dataset(file) as dataset:
            variable, product = _variable(dataset)
            leads = _leads(dataset, issued)
            point = _nearest(dataset, variable, latitude, longitude)
            sums = 1000 * _numbers(variable, *point)
            rain = _rain(variable.name, leads, sums)
    except ConfigurationError as error:
        raise ConfigurationError(error.wrong, file=file) from None
    except (OSError, RuntimeError) as error:  # of the library; a damaged file opens, too
        raise ConfigurationError(f"is not NetCDF that can be read: {error}", file=file) from error
    return Issue(issued, file, None, rain[None, :]), int(match[2] or 0), product


def _variable(dataset: Dataset) -> tuple[Variable[Any], str]:
    """Return the variable of precipitation, and its product."""
    found = [match for name in dataset.variables if (match := _VARIABLE.fullmatch(name))]
    if len(found) != 1:
        names = [match[0] for match in found] or dataset.variables
        raise ConfigurationError(
            "must have one variable of precipitation, such as HRDPS_P_PR_SFC; it has "
            f"{', '.join(names)}"
        )
    name, product = found[0][0], found[0][1]
    if product not in _DELAYS_H:
        raise ConfigurationError(f"must be of {', '.join(_DELAYS_H)}", value=name)
    units = _attribute(dataset[name], "units")
    if units != "m":
        raise ConfigurationError(
            "must be 'm', of the sum since the issue", key=f"{name}:units", value=units
        )
    return dataset[name], product


def _leads(dataset: Dataset, issued: datetime) -> NDArray[np.int64]:
    """Return 0 and the leads of a file's times (h)."""
    if "time" not in dataset.variables:
        raise ConfigurationError("must have a variable 'time'")
    time = dataset["time"]
    if time.dimensions != ("time",):  # sums without a time, or times without a sum
        dimensions = ", ".join(time.dimensions)
        raise ConfigurationError(f"must have the dimension time, not ({dimensions})", key="time")
    units = _attribute(time, "units")
    due = f"hours since {issued:%Y-%m-%d %H:%M:%S}"
    if units != due:
        raise ConfigurationError(
            f"must be '{due}', by the file's name", key="time:units", value=units
        )
    times = _numbers(time)
    leads = np.concatenate(([0.0], times if times.size and times[0] else times[1:]))
    steps = np.diff(leads)
    wrong = np.flatnonzero(~((steps >= 1) & (steps <= _LONGEST_STEP) & (steps % 1 == 0)))
    if wrong.size or not steps.size:
        after = f" after {leads[wrong[0]]:g}" if wrong.size else ""
        raise ConfigurationError(
            f"must have further hours, 1 to {_LONGEST_STEP} from each to the next{after}",
            key="time",
        )
    return leads.astype(np.int64)


def _nearest(
    dataset: Dataset, variable: Variable[Any], latitude: float, longitude: float
) -> tuple[int, int]:
    """Return the indices of the point of the grid that is nearest to a place.

    Nearest is the least angle between both on the sphere, by the haversine.
    """
    (north, latitudes), (east, longitudes) = (_coordinate(dataset, name) for name in _ENDS)
    places = north if north == east else (*north, *east)
    if len(places) != 2 or variable.dimensions != ("time", *places):
        raise ConfigurationError(
            f"must have the dimensions time and two of the places, as latitude ({', '.join(north)})"
            f" and longitude ({', '.join(east)}) have them, not "
            f"({', '.join(variable.dimensions)})", value=variable.name,
        )
    if latitudes.ndim == 1:  # an axis; against the other it is the grid
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


def _coordinate(dataset: Dataset, name: str) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """Return the dimensions and degrees of the variable of a standard name."""
    for variable in dataset.variables.values():
        if _attribute(variable, "standard_name") == name:
            degrees, end = _numbers(variable), _ENDS[name]
            if not (degrees.size and (np.abs(degrees) <= end).all()):
                raise ConfigurationError(
                    f"must have degrees from {-end:g} to {end:g} for every point of the grid, and "
                    "one point or more", key=variable.name,
                )
            return variable.dimensions, degrees
    raise ConfigurationError(f"must have a variable of standard_name '{name}'")


def _attribute(variable: Variable[Any], name: str) -> str:
    """Return an attribute, which may be there as an array of numbers, as text; or none, empty."""
    return str(getattr(variable, name, ""))


def _numbers(variable: Variable[Any], *point: int) -> NDArray[np.float64]:
    """Return the values of a variable, at one point where its last dimensions are the places'.

    NaN is a missing value. NetCDF also has types of text, lists and records, and text of digits
    would become numbers.
    """
    kind, name = variable.datatype, variable.name
    if not (isinstance(kind, np.dtype) and kind.kind in "iuf"):
        raise ConfigurationError("must be of a type of numbers, such as float or int", key=name)
    for packing in _PACKING:
        number = getattr(variable, packing, np.float64(0.0))
        if not isinstance(number, np.number):
            raise ConfigurationError("must be a number", key=f"{name}:{packing}", value=str(number))
    values: NDArray[np.float64] = np.ma.filled(variable[(..., *point)].astype(np.float64), np.nan)
    beyond = np.argwhere(np.abs(values) > _LARGEST)
    if beyond.size:
        index = tuple(beyond[0].tolist())
        raise ConfigurationError(
            "must be finite, and a number of 32 bits",
            key=f"{name}[{', '.join(map(str, index))}]", value=float(values[index]),
        )
    return values


def _rain(name: str, leads: NDArray[np.int64], sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rain of each hour (mm/h) from its sums since the issue (mm).

    Args:
        name: of the variable.
        leads: 0, and those of the sums (h), shape (n + 1,).
        sums: at each time of the file; the sum of lead 0 may be missing, which is 0, and so may the
            last.
    """
    sums = np.concatenate(([0.0], sums[len(sums) - len(leads) + 1 :]))
    known = np.flatnonzero(~np.isnan(sums))[-1] + 1
    if known == 1 or np.isnan(sums[:known]).any():
        raise ConfigurationError(
            f"is missing {leads[np.argmax(np.isnan(sums))]} h after the issue", key=name
        )
    amounts, steps = np.diff(sums[:known]), np.diff(leads[:known])
    falls = np.flatnonzero(amounts < -_ROUNDING_MM)
    if falls.size:
        raise ConfigurationError(
            f"must be the sum since the issue; it falls by {-amounts[falls[0]]:.3g} mm to "
            f"{leads[falls[0] + 1]} h after it", key=name
        )
    rain = np.maximum(amounts, 0.0) / steps
    _, low, high = QUANTITIES[PRECIPITATION]
    beyond = np.flatnonzero(rain > high)
    if beyond.size:
        raise ConfigurationError(
            f"must be {low:g} to {high:g} mm/h, not {rain[beyond[0]]:.4g} before "
            f"{leads[beyond[0] + 1]} h after the issue", key=name
        )
    return np.repeat(rain, steps)
