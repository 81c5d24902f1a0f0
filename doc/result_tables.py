"""The tables of the results, from ``doc/results/*.csv``, which tools/results writes."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from real_season_tables import OVER_ONOFF, TOGETHER, Cell, Table, numbers

from greenroof_ros.common.files import shared_directory

_RESULTS = Path(__file__).resolve().parent / "results"
_NAMES = {"onoff": "on/off"}
_BOUND = "lower bound"
# The roofs, by how the names of their site files begin.
_ROOFS = {"site_z": "the paper's roof", "site_catchment": "the Neubrandenburg roof"}

Row = dict[str, str]


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


def _bound(row: Row) -> float:
    """Return the lower bound on the mean deviation (mm)."""
    return _mm(row) * float(row["bound_m3"]) / float(row["total_deviation_m3"])


def _table(corner: str, cells: Iterable[tuple[str, str, Cell]]) -> Table:
    """Return a table of cells, each with its row and its column, in reading order."""
    rows: dict[str, dict[str, Cell]] = {}
    columns: dict[str, None] = {}
    for name, column, text in cells:
        columns.setdefault(column)
        rows.setdefault(name, {})[column] = text
    return (corner, *columns), [
        (name, *(row.get(column, "") for column in columns)) for name, row in rows.items()
    ]


def _pairs(corner: str, numbers: dict[tuple[str, str], list[str]]) -> Table:
    """Return a table whose cells have several numbers: a column for each is wider than a phone."""
    return _table(corner, ((*place, " / ".join(texts)) for place, texts in numbers.items()))


def methods() -> Table:
    """Return the paper's settings: total, the authors' total, and the mean with each method."""
    path = shared_directory() / "config" / "paper" / "totals.csv"
    with path.open(newline="", encoding="utf-8") as stream:
        authors = {
            (row["controller"], float(row["parameter"])): float(row["total_deviation_m3"])
            for row in csv.DictReader(stream) if row["initial"] == "low-low"
        }
    numbers: dict[tuple[str, str], list[str]] = {}
    for row in read("methods"):
        name = _setting(row, "weight", "fraction")
        if row["evapotranspiration"] == "published":
            parameter = float(row["parameter:weight"] or row["parameter:fraction"])
            totals = (float(row["total_deviation_m3"]), authors[row["controller"], parameter])
            numbers[name, "total / the authors' (m³)"] = [f"{total:.0f}" for total in totals]
        numbers.setdefault((name, "mean / with `fao56` (mm)"), []).append(f"{_mm(row):.2f}")
    return _pairs("setting", numbers)


_WINDOWS = {
    "2021-07-07T02": "the paper's hours", "2021-07-08T05": "23 mm of rain",
    "2021-07-29T00": "14 mm at the end", "2021-07-07T14": "a dry half day",
}


def _window(row: Row) -> str:
    return _WINDOWS[row["start"][:13]]


def windows() -> Table:
    """Return all controllers, with the lower bound."""
    rows = read("windows")
    bounds = {_window(row): _bound(row) for row in rows}
    return _table("", (
        *((_BOUND, window, f"{bound:.2f}") for window, bound in bounds.items()),
        *(
            (
                _setting(row), _window(row),
                (f"{_mm(row):.2f}", f"{_mm(row) / bounds[_window(row)]:.4f}"),
            )
            for row in rows
        ),
    ))


def forecasts() -> Table:
    """Return mean and worst tenth over the seeds of forecasts with errors."""
    rows = read("forecasts")
    skills = dict.fromkeys(row["forecast_skill"] for row in rows if row["forecast_skill"])
    return _table("", (
        (
            _setting(row), f"skill `{skill}`",
            f"{_mm(row):.2f}"
            + (f" / {float(row['worst_tenth_mm']):.2f}" if row["forecast_skill"] else ""),
        )
        for skill in skills for row in rows if row["forecast_skill"] in ("", skill)
    ))


def useless_forecasts() -> Table:
    """Return the cost of useless forecasts."""
    rows = read("useless_forecasts")
    numbers: dict[tuple[str, str], list[str]] = {}
    for file in ("dry.csv", "rain_that_never_comes.csv"):
        for row in rows:
            if row["forecast"] in (file, "perfect"):
                budget = row["parameter:waiting_budget"]
                name = f"{_setting(row)}, {float(budget):g} h" if budget else _setting(row)
                numbers.setdefault((name, _window(row)), []).append(f"{_mm(row):.2f}")
    return _pairs("`waiting_budget`", numbers)


# The columns of errors, by offset and noise (mm) and the minimum on-time (s).
_ERRORS = {
    (0, 0, 0): "no error / noise 2 mm", (0, 2, 0): "no error / noise 2 mm",
    (0, 0, 300): "300 s on and off",
    (-2, 0, 0): "offset -2 / +2 mm", (2, 0, 0): "offset -2 / +2 mm",
}


def robustness() -> Table:
    """Return the cost of sensor and pump errors; the mean over the seeds of noise."""
    values: dict[tuple[str, tuple[int, ...]], list[float]] = {}
    for row in read("robustness"):
        error = (
            *(round(1000 * float(row[f"roof_{name}"])) for name in ("offset", "noise")),
            round(float(row["minimum_on"])),
        )
        values.setdefault((_setting(row), error), []).append(_mm(row))
    numbers: dict[tuple[str, str], list[str]] = {}
    for error, column in _ERRORS.items():
        for (name, other), deviations in values.items():
            if other == error:
                numbers.setdefault((name, column), []).append(f"{np.mean(deviations):.2f}")
    return _pairs("", numbers)


def month() -> Table:
    """Return the deviation by horizon of perfect forecasts."""
    rows = read("month")
    ahead = [row for row in rows if row["parameter:horizon"]]
    controllers = list(dict.fromkeys(row["controller"] for row in ahead))
    bound = _bound(rows[0])

    def text(deviation: float) -> str:
        return f"{deviation:.2f} ({deviation / bound:.3f})"

    return _table("", (
        *(
            (_setting(row), controller, text(_mm(row)))
            for row in rows if not row["parameter:horizon"] for controller in controllers
        ),
        *(
            (f"{float(row['parameter:horizon']):g} h", row["controller"], text(_mm(row)))
            for row in ahead
        ),
        *((_BOUND, controller, text(bound)) for controller in controllers),
    ))


# --- seasons --------------------------------------------------------------------------------------


def roof(row: Row) -> str:
    """Return the name of a row's roof."""
    return next(words for begin, words in _ROOFS.items() if row["site"].startswith(begin))


def _ratio(row: Row) -> str:
    """Return the ratio of a deviation to the deviation of on/off, with its interval."""
    value, low, high = (float(row[name]) for name in ("over_onoff", "low", "high"))
    return f"{value:.3f} ({low:.3f} to {high:.3f})"


def seasons() -> Table:
    """Return the controllers over whole seasons on both roofs."""
    cells: list[tuple[str, str, str]] = []
    for row in sorted(read("seasons"), key=lambda row: float(row["over_onoff"])):
        level = row["parameter:level"] or "1.0"
        name = _setting(row)
        name += f", level {level}" if level != "1.0" else ""
        name += ", perfect" if row["parameter:horizon"] and row["forecast"] == "perfect" else ""
        name += ", no skill" if row["forecast_skill"] == "none" else ""
        if row["over_onoff"] != "1.0":
            cells.append((name, roof(row), f"{_mm(row):.2f} mm, {_ratio(row)}"))
            continue
        bound = 1.0 / float(row["over_least"])
        cells += [
            (name, roof(row), f"{_mm(row):.2f} mm"),
            (_BOUND, roof(row), f"{bound * _mm(row):.2f} mm, {bound:.3f}"),
        ]
    header, rows = _table("controller", cells)
    order = [header.index(words) for words in _ROOFS.values()]
    return (header[0], *_ROOFS.values()), [(row[0], *(row[k] for k in order)) for row in rows]


_GENERATED = {
    ("anticipating_onoff", "real"): "anticipating_onoff, generated forecasts",
    ("lookahead", "real"): "lookahead, generated",
    ("lookahead", "none"): "lookahead, generated without skill",
}
_ISSUED = "lookahead, issued"


def choices() -> Table:
    """Return the table that helps choose: deviations relative to on/off, generated and issued."""
    cells: dict[str, dict[str, str]] = {}
    for row in read("seasons"):
        name = _GENERATED.get((row["controller"], row["forecast_skill"]))
        if name is not None:
            cells.setdefault(name, {})[roof(row)] = _ratio(row)
    roofs = tuple(_ROOFS.values())
    cells[_ISSUED] = {
        place: numbers()[roof, TOGETHER, OVER_ONOFF].text("{:.3f}")
        for roof, place in zip(("paper", "measured"), roofs, strict=True)
    }
    names = (*_GENERATED.values(), _ISSUED)
    rows = [(name, *(cells[name][roof] for roof in roofs)) for name in names]
    return ("controller and forecast", *roofs), rows


RESULTS: dict[str, Callable[[], Table]] = {
    "methods": methods,
    "windows": windows,
    "forecasts": forecasts,
    "useless_forecasts": useless_forecasts,
    "robustness": robustness,
    "month": month,
    "seasons": seasons,
}
