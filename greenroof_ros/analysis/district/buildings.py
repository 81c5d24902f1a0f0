"""The buildings of a district: drawn from distributions or listed in a CSV file."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from greenroof_ros.analysis.district.file import District, Draw, building_keys, is_of_policy
from greenroof_ros.base.errors import ConfigurationError, describe_choices, find_similar
from greenroof_ros.site.file import SiteFile
from greenroof_ros.site.site import Site
from greenroof_ros.weather.table import Row, Table, read_table

Values = NDArray[np.float64]

ID, CELL = "id", "cell"
# A distribution is rejected if its limits leave less of it than this share.
_MIN_SHARE = 1e-3


@dataclass(frozen=True)
class Buildings:
    """The buildings of one draw; the n-th entry of every sequence belongs to the n-th building.

    Buildings adopt in a random order: a building that has a green roof at a low level of adoption
    also has one at every higher level. Those that adopt at the same level form a group, so that
    every building is simulated once, and the district at any adoption is a sum of groups.

    Attributes:
        ids: names of the buildings.
        cells: indices of the buildings' weather cells.
        values: values in which the buildings differ, by key.
        groups: index of the first level of adoption at which each building has a green roof; the
            number of levels for a building that never gets one.
        valves: whether each building has a valve, or an orifice in its place, once it has a
            cistern. The share of these is the same at every level, to within one building.
        lines: lines of the buildings in the CSV file; None if the buildings are drawn.
    """

    ids: Sequence[str]
    cells: NDArray[np.intp]
    values: Mapping[str, Sequence[Any]]
    groups: NDArray[np.intp]
    valves: NDArray[np.bool_]
    lines: Sequence[int] | None

    def take(self, places: Sequence[int]) -> Buildings:
        """Return the buildings at some places."""
        return Buildings(
            [self.ids[place] for place in places], self.cells[places],
            {key: [each[place] for place in places] for key, each in self.values.items()},
            self.groups[places], self.valves[places],
            None if self.lines is None else [self.lines[place] for place in places],
        )


def make_buildings(
    district: District, site: Site, cells: Sequence[str], draw: int, notes: list[str]
) -> Buildings:
    """Return the buildings of a draw.

    The values of one key depend neither on the other keys nor on the number of buildings: if the
    number grows, the first buildings stay the same.

    Args:
        district: the district.
        site: the site that the buildings have in common.
        cells: names of the weather cells; empty if all buildings have the same weather.
        draw: number of the draw, from 0.
        notes: list to which notes on unused columns are added.

    Raises:
        ConfigurationError: if the CSV file is invalid, or a value is outside the range of its key.
    """
    if district.file is not None:
        file = district.find_files("file", district.file)[0]
        ids, of_cell, lines, listed = _read(file, cells, notes)
    else:
        ids = [str(number) for number in range(1, (district.buildings or 0) + 1)]
        of_cell = np.arange(len(ids)) * max(1, len(cells)) // len(ids)
        lines, listed = None, {}
    values = dict(listed)
    for name, each in sorted(district.draw.items(), key=lambda item: item[1].times is not None):
        if name in listed:
            raise district.refuse(f"draw.{name}", f"is also a column of {district.file}", name)
        drawn = _draw(district, name, each, len(ids), district.seed + draw)
        if each.times is not None:
            factor = np.asarray(values.get(each.times, getattr(site, each.times, None)))
            if not np.issubdtype(factor.dtype, np.number):
                raise district.refuse(
                    f"draw.{name}.times", "must be a key with a number for every building"
                )
            drawn = (np.asarray(drawn) * factor).tolist()
        _check(district, name, each, drawn)
        values[name] = drawn
    ranks = np.random.default_rng(district.seed + draw).permutation(len(ids))
    counts = [math.floor(share * len(ids) + 0.5) for share in district.shares]
    before, after = (
        np.floor((ranks + more) * district.valve_share + 1e-9) for more in (0, 1)
    )
    return Buildings(
        ids, of_cell, values, np.searchsorted(counts, ranks, side="right"), after > before, lines
    )


def make_sites(district: District, buildings: Buildings) -> list[Site]:
    """Return the site of each building.

    Raises:
        ConfigurationError: if a building's site is invalid.
    """
    common = SiteFile(district.find_files("site", district.site)[0])
    names, sites = [name for name in buildings.values if not is_of_policy(name)], []
    for place in range(len(buildings.ids)):
        own = {name: buildings.values[name][place] for name in names}
        try:
            sites.append(common.change(district.ticks | own))
        except ConfigurationError as error:
            raise refuse_building(district, buildings, place, error) from None
    return sites


def refuse_building(
    district: District, buildings: Buildings, place: int, error: ConfigurationError
) -> ConfigurationError:
    """Return an error about a building's site that names the building and the value's source.

    The source of a drawn value is the district file. If all buildings share the key, its value is
    invalid only in combination with other keys, so the error names the drawn values.
    """
    building, key = f"building {buildings.ids[place]}", error.key or ""
    name = key.partition(" ")[0]  # the paper's name may follow a plain key
    if name in district.draw:
        return district.refuse(f"draw.{name}", f"{error.expected} ({building})", error.value)
    drawn = [f"{each} = {buildings.values[each][place]}" for each in district.draw]
    if drawn and name not in buildings.values:
        building += f"; drawn: {', '.join(drawn)}"
    return ConfigurationError(
        f"{error.expected} ({building})",
        file=district.path if buildings.lines is None else Path(district.file or ""),
        line=None if buildings.lines is None else buildings.lines[place], key=key,
        value=error.value,
    )


def _check(district: District, name: str, draw: Draw, drawn: Sequence[Any]) -> None:
    """Refuse drawn values that the key does not accept."""
    known = building_keys()[name]
    if bool(draw.names) != bool(known.among):
        wanted = "needs names" if known.among else "must be numbers, not names"
        raise district.refuse(f"draw.{name}", wanted)
    for each in {*drawn} if draw.names else (min(drawn), max(drawn)):
        try:
            known.read(each)
        except ConfigurationError as error:
            raise district.refuse(
                f"draw.{name}", f"{error.expected}, but {each} was drawn; change its values or "
                "limits", each,
            ) from None


def _draw(
    district: District, name: str, draw: Draw, count: int, seed: int
) -> Sequence[Any]:
    """Return a key's value for each building, from the inverse of its distribution."""
    shares = np.random.default_rng([seed, zlib.crc32(name.encode())]).random(count)
    among = draw.values or draw.names
    if among is not None:
        return [among[int(share * len(among))] for share in shares]
    if draw.mean is None or draw.sd is None:
        assert draw.low is not None
        assert draw.high is not None
        return [draw.low + (draw.high - draw.low) * share for share in shares.tolist()]
    low = 0.0 if draw.low is None else draw.low
    high = math.inf if draw.high is None else draw.high
    if draw.sd == 0:
        if not low <= draw.mean <= high:
            raise district.refuse(f"draw.{name}.mean", f"must be from {low:g} to {high:g}")
        return [draw.mean] * count
    variance = math.log1p((draw.sd / draw.mean) ** 2)
    middle, width = math.log(draw.mean) - variance / 2, math.sqrt(variance)
    below, up_to = (
        float(ndtr((math.log(end) - middle) / width)) if end > 0 else 0.0 for end in (low, high)
    )
    if up_to - below < _MIN_SHARE:
        raise district.refuse(
            f"draw.{name}", "has a distribution of which only a share of "
            f"{max(0.0, up_to - below):.2g} is between low and high; change low, high or the mean",
        )
    drawn = np.exp(middle + width * ndtri(below + (up_to - below) * shares))
    values: list[float] = np.clip(drawn, low, high).tolist()  # rounding may exceed the limits
    return values


def _read(
    file: Path, cells: Sequence[str], notes: list[str]
) -> tuple[list[str], NDArray[np.intp], list[int], dict[str, Sequence[Any]]]:
    """Return the name, cell and line of each building in a CSV file, and its other columns."""
    table, known = read_table(file), building_keys()
    needed = (ID, CELL) if cells else (ID,)
    columns = [name for name in table.header if name in known]
    for name in (*needed, *columns):
        table.place(name)  # a column must appear once
    others = [name for name in table.header if name not in (*known, *needed)]
    if others:
        meant = [
            f"{name}: did you mean {' or '.join(alike)}?"
            for name in others if (alike := find_similar(name, known))
        ]
        notes.append(
            f"{file.name}: these columns are not site keys and are ignored: "
            + ", ".join(others) + f" ({'; '.join(meant)})" * bool(meant)
        )
    ids, places = dict[str, int](), list[int]()
    values: dict[str, list[Any]] = {name: [] for name in columns}
    for row in table.rows:
        name = table.cell(row, ID)
        if not name:
            raise table.refuse("must contain a name or number for every building", ID, row)
        if name in ids:
            raise table.refuse(f"is also the name of the building in line {ids[name]}", ID, row)
        ids[name] = row.line or 0
        places.append(cells.index(_read_name(table, row, CELL, cells)) if cells else 0)
        for column in columns:
            key = known[column]
            values[column].append(
                _read_name(table, row, column, key.among) if key.among
                else table.read_number(row, column, key.range)
            )
    return [*ids], np.array(places, dtype=np.intp), [*ids.values()], dict(values)


def _read_name(table: Table, row: Row, column: str, names: Sequence[str]) -> str:
    if (text := table.cell(row, column)) not in names:
        raise table.refuse(describe_choices(names, text), column, row)
    return text
