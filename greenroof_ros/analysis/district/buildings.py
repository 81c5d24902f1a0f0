"""The buildings of a district: drawn from distributions or listed in a CSV file.

Buildings adopt in a random order: a building that has a green roof at a low level of adoption also
has one at every higher level. Those that adopt at the same level form a group, so that every
building is simulated once, and the district at any adoption is a sum of groups.
"""

from __future__ import annotations

import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from greenroof_ros.analysis.district.file import BUILDING_KEYS, POLICY_KEYS, District, Draw
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.site.file import SiteFile
from greenroof_ros.site.site import Site
from greenroof_ros.weather.table import read_table

Values = NDArray[np.float64]

ID, LINE, GROUP = "id", "line", "group"


def list_buildings(district: District, notes: list[str]) -> pl.DataFrame:
    """Return the names of the buildings, their lines in the CSV file, and its other columns.

    Args:
        district: the district.
        notes: list to which a note on unused columns is added.

    Raises:
        ConfigurationError: if the CSV file is invalid.
    """
    if district.file is None:
        ids = [str(number) for number in range(1, (district.buildings or 0) + 1)]
        return pl.DataFrame({ID: ids, LINE: [0] * len(ids)})
    table = read_table(district.find_files("file", district.file)[0])
    columns = [name for name in table.header if name in BUILDING_KEYS]
    if others := [name for name in table.header if name not in (ID, *columns)]:
        notes.append(
            f"{table.file.name}: these columns are not keys of a building and are ignored: "
            + ", ".join(others)
        )
    rows = dict[str, dict[str, Any]]()
    for row in table.rows:
        name = table.cell(row, ID)
        if not name or name in rows:
            raise table.refuse("must be a name or number of its own", ID, row)
        rows[name] = {ID: name, LINE: row.line} | {
            each: table.read_number(row, each, BUILDING_KEYS[each].range) for each in columns
        }
    return pl.DataFrame([*rows.values()])


def make_buildings(district: District, site: Site, listed: pl.DataFrame, draw: int) -> pl.DataFrame:
    """Return the buildings of a draw.

    The values of one key depend neither on the other keys nor on the number of buildings: if the
    number grows, the first buildings stay the same.

    Args:
        district: the district.
        site: the site that the buildings have in common.
        listed: the buildings of :func:`list_buildings`.
        draw: number of the draw, from 0.

    Returns:
        The listed columns and the drawn keys; ``adopts_at``, the first level of adoption at which
        each building has a green roof, if it ever has one; and its ``group``, the index of this
        level, or the number of levels.

    Raises:
        ConfigurationError: if a value is outside the range of its key.
    """
    count, seed = len(listed), district.seed + draw
    values = {name: listed[name].to_numpy() for name in listed.columns[2:]}
    for name, each in sorted(district.draw.items(), key=lambda item: item[1].times is not None):
        if name in listed.columns:
            raise district.refuse(f"draw.{name}", f"is also a column of {district.file}", name)
        drawn = _draw(name, each, count, seed)
        if each.times is not None:
            factor = values.get(each.times, getattr(site, each.times, None))
            drawn = drawn * np.asarray(factor, float)  # NaN without a value
        key = BUILDING_KEYS[name]
        for value in (float(drawn.min()), float(drawn.max())):
            if value not in key.range:
                raise district.refuse(f"draw.{name}", f"must be {key.limits}", value)
        values[name] = drawn
    ranks = np.random.default_rng(seed).permutation(count)
    counts = [math.floor(share * count + 0.5) for share in district.shares]
    groups = np.searchsorted(counts, ranks, side="right")
    return listed.with_columns(
        **{name: pl.Series(each) for name, each in values.items()}, group=pl.Series(groups),
        adopts_at=pl.Series([*district.shares, None], dtype=pl.Float64).gather(groups),
    )


def make_sites(district: District, buildings: pl.DataFrame) -> list[Site]:
    """Return the site of each building.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    common, sites = SiteFile(district.find_files("site", district.site)[0]), []
    for building in buildings.iter_rows(named=True):
        own = {n: v for n, v in building.items() if n in BUILDING_KEYS and n not in POLICY_KEYS}
        try:
            sites.append(common.change({"tau": district.tau, "M": 1} | own))
        except ConfigurationError as error:
            raise refuse_building(district, building, error) from None
    return sites


def refuse_building(
    district: District, building: dict[str, Any], error: ConfigurationError
) -> ConfigurationError:
    """Return an error about a building's site that names the building and the value's source."""
    expected, key = f"{error.expected} (building {building[ID]})", error.key or ""
    name = key.partition(" ")[0]  # the paper's name may follow a plain key
    if name in district.draw:
        return district.refuse(f"draw.{name}", expected, error.value)
    file, line = (Path(district.file), building[LINE]) if district.file else (district.path, None)
    return ConfigurationError(expected, file=file, line=line, key=key, value=error.value)


def _draw(name: str, draw: Draw, count: int, seed: int) -> Values:
    """Return a key's value for each building, from the inverse of its distribution."""
    shares = np.random.default_rng([seed, zlib.crc32(name.encode())]).random(count)
    if draw.values:
        return np.asarray(np.array(draw.values)[(shares * len(draw.values)).astype(int)])
    mean, sd = np.array([draw.mean, draw.sd], float).tolist()
    low, high = draw.low or 0.0, math.inf if draw.high is None else draw.high
    variance = math.log1p((sd / mean) ** 2)
    middle, width = math.log(mean) - variance / 2, math.sqrt(variance)
    below, up_to = (
        ndtr((math.log(end) - middle) / width) if end > 0 else 0.0 for end in (low, high)
    )
    drawn = np.exp(middle + width * ndtri(below + (up_to - below) * shares))
    return np.asarray(np.clip(drawn, low, high))  # rounding may exceed the limits
