"""The tables of real seasons, from ``doc/results/real_seasons.csv``.

``python tools/real_seasons ARCHIVES -o DIR`` writes that file as ``DIR/real_seasons.csv``: a row
for each number of a run, with its 95 % interval.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).resolve().parent / "results" / "real_seasons.csv"

YEAR, SEASON = "20 February to 31 December", "May to October"
ALL, _DRIER, _WETTER = "all weeks", "drier half", "wetter half"
ISSUED, DRESSED, CROSSED = "as issued", "dressed", "dressed by the other half"
_NESTED = f"{CROSSED} with its own numbers"
OVER_ONOFF, _GAINED, MEAN = "over on/off", "gained", "mean deviation (mm)"
_SERVICES = ("GEM", "KNMI", "GFS")

_EVAPOTRANSPIRATION = "actual over potential evapotranspiration"

# What an owner sees, by measure: heading and format.
_OWNER = {
    MEAN: (MEAN, "{:.2f}"),
    "water stress (h)": ("water stress (h)", "{:.0f}"),
    _EVAPOTRANSPIRATION: (_EVAPOTRANSPIRATION, "{:.3f}"),
    "pumped (m³)": ("pumped (m³)", "{:.1f}"),
    "share of it drained": ("of it drained", "{:.0%}"),
    "rain kept": ("rain kept", "{:.0%}"),
    "rain kept above 20 mm/h": ("kept above 20 mm/h", "{:.0%}"),
    "rain kept above 10 mm in 24 h": ("kept above 10 mm in 24 h", "{:.0%}"),
}
_TARGETS = {"45.7 mm": "measured", "39 mm": "measured, target 39 mm"}

Table = tuple[Sequence[str], list[tuple[str, ...]]]


class Number(NamedTuple):
    """A number, and the ends of its 95 % interval; None if it has none."""

    value: float
    low: float | None
    high: float | None

    def text(self, form: str, interval: bool = True) -> str:
        """Return it as a cell, with or without its interval."""
        text = form.format(self.value).replace("%", " %")
        if self.low is None or not interval:
            return text
        low, high = (form.format(end).removesuffix("%") for end in (self.low, self.high))
        return f"{text} ({low} to {high})"


@cache
def numbers() -> dict[tuple[str, ...], Number]:
    """Return all numbers by roof, period, weeks, forecast, form and measure."""
    with FILE.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.reader(stream))[1:]
    return {
        tuple(row[:6]): Number(float(row[6]), *(float(end) if end else None for end in row[7:]))
        for row in rows
    }


def compared(roof: str, period: str, weeks: str, forms: Sequence[str]) -> Table:
    """Return each forecast's deviation over on/off's and over no rain's, and what it gains."""
    measures = {OVER_ONOFF: "{:.3f}", "over no rain": "{:.3f}", _GAINED: "{:.0%}"}
    named = [key for key in numbers() if key[:3] == (roof, period, weeks)]
    rows = []
    for forecast in dict.fromkeys(key[3] for key in named):
        if forecast in ("on/off", "least possible"):
            continue
        keys = [
            (roof, period, weeks, forecast, form, measure) for form in forms for measure in measures
        ]
        rows.append((forecast, *(
            numbers()[key].text(measures[key[-1]]) if key in numbers() else "" for key in keys
        )))
    heads = [f"{form.replace(f'{CROSSED} with', 'with')}: {measure}"
             for form in forms for measure in measures]
    return ("forecast", *heads), rows


def season() -> Table:
    """Return the deviation over on/off's in the season, on both roofs."""
    rows = {
        "no rain": ("no rain", ISSUED),
        "placebo, dressed": ("placebo", DRESSED),
        "a service as issued": ("", ISSUED),
        "three as one ensemble": ("three", ISSUED),
        "the same, dressed": ("three", DRESSED),
        "perfect": ("perfect", ISSUED),
    }

    def text(roof: str, forecast: str, form: str) -> str:
        shares = [
            numbers()[roof, SEASON, ALL, source, form, OVER_ONOFF]
            for source in ([forecast] if forecast else _SERVICES)
        ]
        if forecast:
            return shares[0].text("{:.3f}")
        return " to ".join(f"{end(share.value for share in shares):.3f}" for end in (min, max))

    return ("forecast", "measured roof", "paper's roof"), [
        (words, *(text(roof, *shown) for roof in ("measured", "paper")))
        for words, shown in rows.items()
    ]


def best_use() -> Table:
    """Return what the best use of each service would gain, beside what it gains."""
    forms = (
        ISSUED, DRESSED, "scaled by the other half", "scaled by its own half",
        *(f"used ideally, draw {draw}" for draw in (1, 2, 3)),
    )
    keys = {
        source: [("measured", SEASON, ALL, source, form, _GAINED) for form in forms]
        for source in _SERVICES
    }
    return ("forecast", *forms), [
        (source, *(numbers()[key].text("{:.0%}") if key in numbers() else "" for key in row))
        for source, row in keys.items()
    ]


def known(period: str) -> Table:
    """Return how well each service forecasts the rain of two days."""
    heads = [f"{weeks}: {measure}" for weeks in (ALL, _DRIER, _WETTER)
             for measure in ("r²", "bias")]
    return ("forecast", *heads), [
        (f"{forecast}, {form}", *(
            f"{numbers()['measured', period, weeks, forecast, form, measure].value:.2f}"
            for weeks in (ALL, _DRIER, _WETTER) for measure in ("r²", "bias")
        ))
        for forecast in ("three", "placebo", *_SERVICES) for form in (ISSUED, DRESSED)
    ]


def owner(period: str, measures: Sequence[str], interval: bool) -> Table:
    """Return what an owner sees of the measured roof, at both targets."""
    shown = (
        ("on/off", ISSUED), ("no rain", ISSUED), ("three", ISSUED), ("three", DRESSED),
        ("perfect", ISSUED),
    )
    rows = []
    for target, roof in _TARGETS.items():
        for forecast, form in shown:
            key = roof, period, ALL, forecast, form
            if (*key, measures[0]) in numbers():
                name = f"{target}, {forecast}{' dressed' if form == DRESSED else ''}"
                rows.append((name, *(
                    numbers()[(*key, measure)].text(_OWNER[measure][1], interval)
                    for measure in measures
                )))
    return ("target, forecast", *(_OWNER[measure][0] for measure in measures)), rows


REAL_SEASONS: dict[str, Callable[[], Table]] = {
    "season": season,
    "owner": partial(owner, YEAR, [
        measure for measure in _OWNER if measure != "share of it drained"
    ], interval=False),
    "owner year": partial(owner, YEAR, list(_OWNER), interval=True),
    "owner season": partial(owner, SEASON, list(_OWNER), interval=True),
    "measured year": partial(compared, "measured", YEAR, ALL, (ISSUED, DRESSED)),
    "measured wetter half": partial(
        compared, "measured", YEAR, _WETTER, (ISSUED, CROSSED, _NESTED)
    ),
    "measured drier half": partial(compared, "measured", YEAR, _DRIER, (ISSUED, CROSSED, _NESTED)),
    "paper year": partial(compared, "paper", YEAR, ALL, (ISSUED, DRESSED)),
    "measured season": partial(compared, "measured", SEASON, ALL, (ISSUED, DRESSED)),
    "paper season": partial(compared, "paper", SEASON, ALL, (ISSUED, DRESSED)),
    "best use": best_use,
    "known year": partial(known, YEAR),
    "known season": partial(known, SEASON),
}
