"""The buildings of a district: drawn from distributions or listed in a CSV file."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from greenroof_ros.analysis.district.district_file import District, Draw, building_keys
from greenroof_ros.base.errors import ConfigurationError, describe_choices, find_similar
from greenroof_ros.site.site import Site
from greenroof_ros.weather.table import Row, Table, read_table

Values = NDArray[np.float64]

ID, CELL = "id", "cell"
# A distribution is rejected if its limits leave less of it than this share.
_MIN_SHARE = 1e-3


@dataclass(frozen=True)
class Buildings:
    """Some buildings of a district; the n-th entry of every sequence belongs to the n-th building.

    Attributes:
        ids: names of the buildings.
        cells: indices of the buildings' weather cells.
        ranks: positions of the buildings in the order of adoption.
        values: values in which the buildings differ, by key.
        file: file that lists the buildings, or the district file if the buildings are drawn.
        lines: lines of the buildings in the file; None if the buildings are drawn.
        drawn: lines of the distributions in the district file, by key.
        district_file: path of the district file.
    """

    ids: Sequence[str]
    cells: NDArray[np.intp]
    ranks: NDArray[np.intp]
    values: Mapping[str, Sequence[Any]]
    file: Path
    lines: Sequence[int] | None
    drawn: Mapping[str, int | None]
    district_file: Path

    def __len__(self) -> int:
        """Return the number of buildings."""
        return len(self.ids)

    def part(self, places: slice) -> Buildings:
        """Return the buildings in a range of positions."""
        return replace(
            self, ids=self.ids[places], cells=self.cells[places], ranks=self.ranks[places],
            values={key: values[places] for key, values in self.values.items()},
            lines=None if self.lines is None else self.lines[places],
        )

    def refuse(self, place: int, error: ConfigurationError) -> ConfigurationError:
        """Return an error about a building's site that names the building and the value's source.

        The source of a drawn value is the district file. If all buildings share the key, its value
        is invalid only in combination with other keys, so the error names the drawn values.

        Args:
            place: the building's position in the sequences.
            error: error about the building's site.
        """
        building, key = f"building {self.ids[place]}", error.key
        name = (key or "").partition(" ")[0]  # the paper's name may follow a plain key
        if name in self.drawn:
            return ConfigurationError(
                f"{error.expected} ({building})", file=self.district_file, line=self.drawn[name],
                key=f"draw.{key}", value=error.value,
            )
        if name not in self.values:
            drawn = {each: self.values[each][place] for each in self.drawn}
            building += "; drawn: " * bool(drawn) + ", ".join(
                f"{each} = {value if isinstance(value, str) else f'{value:.6g}'}"
                for each, value in drawn.items()
            )
        return ConfigurationError(
            f"{error.expected} ({building})", file=self.file,
            line=None if self.lines is None else self.lines[place], key=key, value=error.value,
        )


def make_buildings(
    district: District, site: Site, cells: Sequence[str], notes: list[str]
) -> Buildings:
    """Return the buildings of a district, in the order of their cells.

    The values of one key depend neither on the other keys nor on the number of buildings: if the
    number grows, the first buildings stay the same.

    Args:
        district: the district.
        site: the site that the buildings have in common.
        cells: names of the weather cells; empty if all buildings have the same weather.
        notes: list to which notes on unused columns are added.

    Raises:
        ConfigurationError: if the CSV file is invalid, or a value is outside the range of its key.
    """
    if district.file is not None:
        file = district.find_files("file", district.file)[0]
        ids, of_cell, lines, listed = _read(file, cells, notes)
    else:
        assert district.buildings is not None
        file, lines, listed = district.path, None, {}
        ids = [str(number) for number in range(1, district.buildings + 1)]
        of_cell = np.arange(len(ids)) * max(1, len(cells)) // len(ids)
    values: dict[str, Sequence[Any]] = {}
    known = building_keys()
    for name, draw in sorted(district.draw.items(), key=lambda item: item[1].times is not None):
        if name in listed:
            raise district.refuse(f"draw.{name}", f"is also a column of {file.name}", name)
        values[name] = _draw(district, name, draw, len(ids))
        if draw.times is not None:
            factor = {**listed, **values}.get(draw.times, getattr(site, draw.times, None))
            if not np.issubdtype(np.asarray(factor).dtype, np.number):
                raise district.refuse(
                    f"draw.{name}.times", "must be a key with a number for every building"
                )
            values[name] = (np.asarray(values[name]) * np.asarray(factor, dtype=float)).tolist()
        if bool(draw.names) != bool(known[name].among):
            raise district.refuse(
                f"draw.{name}", "needs names" if known[name].among else "must be numbers, not names"
            )
        for drawn in {*(draw.names or ())}:
            known[name].read(
                drawn, file=district.path, line=district.line(f"draw.{name}.names"),
                key=f"draw.{name}.names",
            )
        if draw.names is None:
            allowed = known[name].range
            for extreme in (np.min(values[name]), np.max(values[name])):
                if extreme not in allowed:
                    raise district.refuse(
                        f"draw.{name}", f"{allowed.expected()}, but {extreme:.6g} was drawn; "
                        + ("change its values" if draw.values else "set low and high"),
                    )
    ranks = np.random.default_rng(district.seed).permutation(len(ids))
    order = np.argsort(of_cell, kind="stable")
    everything = {key: [column[n] for n in order] for key, column in {**listed, **values}.items()}
    return Buildings(
        [ids[n] for n in order], of_cell[order], ranks[order], everything, file,
        None if lines is None else [lines[n] for n in order],
        {name: district.line(f"draw.{name}") for name in district.draw}, district.path,
    )


def _draw(district: District, name: str, draw: Draw, count: int) -> Sequence[Any]:
    """Return a key's value for each building, from the inverse of its distribution."""
    shares = np.random.default_rng([district.seed, zlib.crc32(name.encode())]).random(count)
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
    table = read_table(file)
    needed = (ID, CELL) if cells else (ID,)
    for name in needed:
        table.place(name)
    known = building_keys()
    columns = [name for name in table.header if name in known]
    others = [name for name in table.header if name not in (*known, *needed)]
    if others:
        meant = [
            f"{name}: did you mean {' or '.join(alike)}?"
            for name in others if (alike := find_similar(name, known))
        ]
        notes.append(
            f"{file.name}: these columns are not site keys and are ignored: "
            + ", ".join(others)
            + f" ({'; '.join(meant)})" * bool(meant)
        )
    for name in columns:
        table.place(name)  # a column may appear only once
    ids, places, lines = dict[str, int](), list[int](), list[int]()
    values: dict[str, list[Any]] = {name: [] for name in columns}
    for row in table.rows:
        name, line = table.cell(row, ID), row.line or 0
        if not name:
            raise table.refuse("must contain a name or number for every building", ID, row)
        if name in ids:
            raise table.refuse(f"is also the name of the building in line {ids[name]}", ID, row)
        ids[name] = line
        if cells:
            cell = table.cell(row, CELL)
            if cell not in cells:
                raise table.refuse(f"must be one of the cells {', '.join(cells)}", CELL, row)
            places.append(cells.index(cell))
        lines.append(line)
        for column in columns:
            values[column].append(_read_value(table, row, column))
    cell_of = np.array(places if cells else [0] * len(ids), dtype=np.intp)
    return [*ids], cell_of, lines, dict(values)


def _read_value(table: Table, row: Row, column: str) -> Any:
    key = building_keys()[column]
    if key.among:
        text = table.cell(row, column)
        if text not in key.among:
            raise table.refuse(describe_choices(key.among, text), column, row)
        return text
    return table.read_number(row, column, key.range)
