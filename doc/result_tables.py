"""The tables and figures of the results, from ``doc/results/*.csv``, which tools/results writes.

A table has a figure of the same numbers: a panel for each of its columns, a bar or a point for each
of its rows. The colour shows the controller, and is the same in all figures.
"""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from real_season_tables import OVER_ONOFF, TOGETHER, numbers

from greenroof_ros.common.files import shared_directory

_RESULTS = Path(__file__).resolve().parent / "results"
_DEVIATION = "mean deviation (mm)"
_NAMES = {"onoff": "on/off"}
LEAST = "least possible"
_ROOFS = {"site_z": "the paper's roof", "site_catchment": "a measured roof"}
_RATIO = "deviation over on/off's"

Row = dict[str, str]


class Mark(NamedTuple):
    """A number in a figure.

    Attributes:
        panel: title of its panel.
        row: name of its row there.
        controller: which controller it belongs to, for the colour.
        value: the number.
        beside: a second number of the same row, drawn as a black line; None if there is none.
        low: lower end of its interval; None if there is none.
        high: upper end.
    """

    panel: str
    row: str
    controller: str
    value: float
    beside: float | None = None
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Figure:
    """The content of a figure.

    Attributes:
        about: description, for readers who cannot see it.
        axis: title of all its horizontal axes, with the unit.
        marks: its numbers, in reading order.
        columns: number of panels side by side.
        ratio: whether the numbers are ratios, compared with 1; otherwise they are bars from 0.
        form: format of the numbers beside the marks.
    """

    about: str
    axis: str
    marks: tuple[Mark, ...]
    columns: int
    ratio: bool = False
    form: str = ".2f"

    @property
    def digest(self) -> str:
        """Identifies the numbers of the figure."""
        return hashlib.sha256(json.dumps(asdict(self)).encode()).hexdigest()


class Result(NamedTuple):
    """A table, and its figure."""

    header: tuple[str, ...]
    rows: list[tuple[str, ...]]
    figure: Figure


def read(name: str) -> list[Row]:
    """Return the rows of a table of results."""
    with (_RESULTS / f"{name}.csv").open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def _setting(row: Row, *parameters: str) -> str:
    """Return the name of a controller, with some of its parameters."""
    values = (row.get(f"parameter:{name}") for name in parameters)
    numbers = (np.format_float_positional(float(value), trim="-") for value in values if value)
    return " ".join([_NAMES.get(row["controller"], row["controller"]), *numbers])


def _mm(row: Row) -> float:
    return float(row["mean_deviation_mm"])


def _least(row: Row) -> float:
    """Return the least possible mean deviation (mm)."""
    return _mm(row) * float(row["bound_m3"]) / float(row["total_deviation_m3"])


def methods() -> Result:
    """Return the paper's settings, with the authors' totals, and with the other method."""
    path = shared_directory() / "config" / "paper" / "totals.csv"
    with path.open(newline="", encoding="utf-8") as stream:
        authors = {
            (row["controller"], float(row["parameter"])): float(row["total_deviation_m3"])
            for row in csv.DictReader(stream) if row["initial"] == "low-low"
        }
    marks, cells = [], {}
    for row in read("methods"):
        total, name = float(row["total_deviation_m3"]), _setting(row, "weight", "fraction")
        mark = Mark(row["evapotranspiration"], name, row["controller"], _mm(row))
        if mark.panel == "published":
            parameter = float(row["parameter:weight"] or row["parameter:fraction"])
            theirs = authors[row["controller"], parameter]
            cells[name] = [f"{total:.0f}", f"{theirs:.0f}"]
            mark = mark._replace(beside=mark.value * theirs / total)
        cells[name].append(f"{mark.value:.2f}")
        marks.append(mark)
    figure = Figure("By setting", _DEVIATION, tuple(marks), 2)
    heads = ("setting", "total (m³)", "the authors' (m³)", "mean (mm)", "mean, `fao56` (mm)")
    return Result(heads, [(name, *row) for name, row in cells.items()], figure)


_WINDOWS = {
    "2021-07-07T02": "the paper's hours", "2021-07-08T05": "23 mm of rain",
    "2021-07-29T00": "14 mm at the end", "2021-07-07T14": "a dry half day",
}


def _window(row: Row) -> str:
    return _WINDOWS[row["start"][:13]]


def windows() -> Result:
    """Return all controllers, with the least possible deviation."""
    rows = read("windows")
    least = {_window(row): _least(row) for row in rows}
    figure = Figure("By controller", _DEVIATION, (
        *(Mark(window, LEAST, LEAST, value) for window, value in least.items()),
        *(Mark(_window(row), _setting(row), row["controller"], _mm(row)) for row in rows),
    ), 3)

    def cells(mark: Mark) -> tuple[str]:
        times = mark.value / least[mark.panel]
        return (f"{mark.value:.2f}" + ("" if mark.row == LEAST else f" ({times:.4f})"),)

    return Result(("", *least), _by_row(figure, cells), figure)


def forecasts() -> Result:
    """Return mean and worst tenth over the seeds of forecasts with errors."""
    rows = read("forecasts")
    skills = dict.fromkeys(row["forecast_skill"] for row in rows if row["forecast_skill"])
    figure = Figure(
        "By skill", _DEVIATION, tuple(
            Mark(f"skill {skill}", _setting(row), row["controller"], _mm(row),
                 float(row["worst_tenth_mm"]) if row["forecast_skill"] else None)
            for skill in skills for row in rows if row["forecast_skill"] in ("", skill)
        ), 3,
    )
    return _plain("", figure)


def useless_forecasts() -> Result:
    """Return the cost of useless forecasts."""
    forecasts = {"dry.csv": "no rain", "rain_that_never_comes.csv": "rain"}
    marks = []
    for row in read("useless_forecasts"):
        budget = row["parameter:waiting_budget"]
        name = f"{_setting(row)}, {float(budget):g} h" if budget else _setting(row)
        for file, words in forecasts.items():
            if row["forecast"] in (file, "perfect"):
                marks.append(Mark(f"{_window(row)}, {words}", name, row["controller"], _mm(row)))
    order = [f"{window}, {words}" for window in ("the paper's hours", "a dry half day")
             for words in forecasts.values()]
    figure = Figure(
        "By forecast", _DEVIATION,
        tuple(sorted(marks, key=lambda mark: order.index(mark.panel))), 2,
    )
    return _plain("`waiting_budget`", figure)


def robustness() -> Result:
    """Return the cost of sensor and pump errors; the mean over the seeds of noise."""
    values: dict[tuple[str, str], list[float]] = {}
    for row in read("robustness"):
        offset, noise = (1000 * float(row[f"roof_{error}"]) for error in ("offset", "noise"))
        errors = (
            f"offset {offset:+.0f} mm" if offset
            else f"noise {noise:.0f} mm" if noise
            else f"{float(row['minimum_on']):.0f} s on and off" if float(row["minimum_on"])
            else "none"
        )
        values.setdefault((row["controller"], errors), []).append(_mm(row))
    figure = Figure("By error", _DEVIATION, tuple(
        Mark(_NAMES.get(name, name), errors, name, float(np.mean(deviations)))
        for (name, errors), deviations in values.items()
    ), 2)
    return _plain("error", figure)


def month() -> Result:
    """Return the deviation by horizon of perfect forecasts."""
    rows = read("month")
    without = [row for row in rows if not row["parameter:horizon"]]
    ahead = [row for row in rows if row["parameter:horizon"]]
    panels = list(dict.fromkeys(row["controller"] for row in ahead))
    least = _least(rows[0])
    marks = [
        Mark(panel, _setting(row), row["controller"], _mm(row))
        for row in without for panel in panels
    ]
    marks += [
        Mark(row["controller"], f"{float(row['parameter:horizon']):g} h", row["controller"],
             _mm(row))
        for row in ahead
    ]
    marks += [Mark(panel, LEAST, LEAST, least) for panel in panels]
    figure = Figure("By horizon", _DEVIATION, tuple(marks), 2)
    return Result(
        ("", *(f"`{panel}`" for panel in panels)),
        _by_row(figure, lambda mark: (f"{mark.value:.2f} ({mark.value / least:.3f})",)), figure,
    )


# --- seasons --------------------------------------------------------------------------------------


def _roof(row: Row) -> str:
    return next(words for begin, words in _ROOFS.items() if row["site"].startswith(begin))


def _ratio(panel: str, name: str, row: Row, beside: float | None = None) -> Mark:
    """Return the ratio of a deviation to on/off's, with its interval if it is known."""
    ends = (float(row[end]) if row[end] else None for end in ("low", "high"))
    return Mark(panel, name, row["controller"], float(row["over_onoff"]), beside, *ends)


def _interval(mark: Mark) -> str:
    if mark.low is None:
        return f"{mark.value:.3f}"
    return f"{mark.value:.3f} ({mark.low:.3f} to {mark.high:.3f})"


def seasons() -> Result:
    """Return the controllers over whole seasons on both roofs."""
    roofs = list(_ROOFS.values())
    marks: dict[tuple[str, str], Mark] = {}
    cells: dict[tuple[str, str], str] = {}
    for row in sorted(read("seasons"), key=lambda row: float(row["over_onoff"])):
        level = row["parameter:level"] or "1.0"
        name = _setting(row)
        name += f", level {level}" if level != "1.0" else ""
        name += ", perfect" if row["parameter:horizon"] and row["forecast"] == "perfect" else ""
        name += ", no skill" if row["forecast_skill"] == "none" else ""
        case = _roof(row), name
        marks[case] = _ratio(*case, row)
        if row["over_onoff"] != "1.0":
            cells[case] = f"{_mm(row):.2f} mm, {_interval(marks[case])}"
            continue
        cells[case] = f"{_mm(row):.2f} mm"
        least = 1.0 / float(row["over_least"])
        marks[case[0], LEAST] = Mark(case[0], LEAST, LEAST, least)
        cells[case[0], LEAST] = f"{least * _mm(row):.2f} mm, {least:.3f}"
    figure = Figure(
        "By controller", _RATIO,
        tuple(sorted(marks.values(), key=lambda mark: roofs.index(mark.panel))), 2, ratio=True,
    )
    names = dict.fromkeys(name for _, name in marks)
    return Result(
        ("controller", *roofs),
        [(name, *(cells[roof, name] for roof in roofs)) for name in names], figure,
    )


def horizons() -> Result:
    """Return the deviation by horizon of forecasts with errors, and of perfect ones."""
    rows = {
        (_roof(row), f"{float(row['parameter:horizon']):g} h", row["forecast"] == "perfect"): row
        for row in read("horizons") if row["parameter:horizon"]
    }
    figure = Figure(
        "By horizon", _RATIO, tuple(
            _ratio(roof, horizon, row, float(rows[roof, horizon, True]["over_onoff"]))
            for (roof, horizon, perfect), row in rows.items() if not perfect
        ), 2, ratio=True,
    )

    def cells(mark: Mark) -> tuple[str, str]:
        errors, perfect = (rows[mark.panel, mark.row, perfect] for perfect in (False, True))
        return (
            f"{_mm(errors):.2f} mm, {_interval(mark)}", f"{_mm(perfect):.2f} mm, {mark.beside:.3f}"
        )

    heads = [text for roof in _ROOFS.values() for text in (roof, "perfect")]
    return Result(("`horizon`", *heads), _by_row(figure, cells), figure)


def sizing() -> Result:
    """Return the mains water that each cistern saves, beginning as empty as allowed, and full."""
    saved = {
        (row["initial"], float(row["cistern_m3"]), float(row["green_roof_m2"])): row
        for row in read("sizing")
    }
    figure = Figure(
        "By size", "mains water saved (m³)", tuple(
            Mark(f"{roof:g} m²", f"{cistern:g} m³", "",
                 *(float(row[name]) for row, name in (
                     (row, "saved_m3"), (saved["full", cistern, roof], "saved_m3"),
                     (row, "low"), (row, "high"),
                 )))
            for (initial, cistern, roof), row in saved.items() if initial == "site"
        ), 3, form=".1f",
    )

    def cells(mark: Mark) -> tuple[str]:
        return (f"{mark.value:.1f} ({mark.low:.1f} to {mark.high:.1f}), {mark.beside:.1f}",)

    return Result(
        ("cistern", *dict.fromkeys(mark.panel for mark in figure.marks)), _by_row(figure, cells),
        figure,
    )


_GENERATED = {
    ("anticipating_onoff", "real"): "`anticipating_onoff`, generated forecasts",
    ("lookahead", "real"): "`lookahead`, generated",
    ("lookahead", "none"): "`lookahead`, generated without skill",
}
_ISSUED = "`lookahead`, issued"


def choices() -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the table that helps choose: deviations over on/off's, generated and issued."""
    cells: dict[str, dict[str, str]] = {}
    for row in read("seasons"):
        name = _GENERATED.get((row["controller"], row["forecast_skill"]))
        if name is not None:
            cells.setdefault(name, {})[_roof(row)] = _interval(_ratio("", "", row))
    roofs = tuple(_ROOFS.values())
    cells[_ISSUED] = {
        place: numbers()[roof, TOGETHER, OVER_ONOFF].text("{:.3f}")
        for roof, place in zip(("paper", "measured"), roofs, strict=True)
    }
    names = (*_GENERATED.values(), _ISSUED)
    rows = [(name, *(cells[name][roof] for roof in roofs)) for name in names]
    return ("controller and forecast", *roofs), rows


# --- from marks to cells and drawings -------------------------------------------------------------


def numbers_of(figure: Figure, mark: Mark) -> str:
    """Return the numbers of a mark, as cells and figures show them."""
    numbers = (mark.value,) if mark.beside is None else (mark.value, mark.beside)
    return " / ".join(f"{number:{figure.form}}" for number in numbers)


def _plain(corner: str, figure: Figure) -> Result:
    """Return a table with the numbers of a figure, unchanged."""
    panels = dict.fromkeys(mark.panel for mark in figure.marks)
    return Result(
        (corner, *panels), _by_row(figure, lambda mark: (numbers_of(figure, mark),)), figure
    )


def _by_row(figure: Figure, cells: Callable[[Mark], Iterable[str]]) -> list[tuple[str, ...]]:
    """Return the rows of a table with the numbers of a figure, panel by panel."""
    rows: dict[str, list[str]] = {}
    for mark in figure.marks:
        rows.setdefault(mark.row, []).extend(cells(mark))
    return [(name, *row) for name, row in rows.items()]


RESULTS: dict[str, Callable[[], Result]] = {
    "methods": methods,
    "windows": windows,
    "forecasts": forecasts,
    "useless_forecasts": useless_forecasts,
    "robustness": robustness,
    "month": month,
    "seasons": seasons,
    "horizons": horizons,
    "sizing": sizing,
}
