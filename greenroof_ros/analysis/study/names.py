"""Names of a study's runs, by what differs between them, and the groups that a report compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

from greenroof_ros.analysis.study.grid import Case
from greenroof_ros.recording.results_table import find_differing_keys, format_exactly

_SEASON_HOURS = 168
"""shorter runs are no season, although they may start on one day of several years (h)"""


class Names:
    """Names of a study's cases: the controller, and the facts that differ between cases."""

    def __init__(self, cases: Sequence[Case]) -> None:
        """Find what differs between all cases, and between the cases of each controller."""
        self._facts = find_differing_keys([_facts(case) for case in cases])
        self._forecasts = len({_forecast(case, seed=False) for case in cases}) > 1
        self._values = {
            name: find_differing_keys(
                [_values(case) for case in cases if case.controller.name == name]
            )
            for name in {case.controller.name for case in cases}
        }
        years: dict[tuple[object, ...], set[int]] = {}
        for case in cases:
            years.setdefault(_season(case), set()).add(datetime.fromisoformat(case.start).year)
        self._seasons = {
            season for season, of_season in years.items() if season[0] and len(of_season) > 1
        }
        self._windows = find_differing_keys([self._window(case) for case in cases])

    def name(self, case: Case) -> str:
        """Return the full name of a case."""
        facts = _facts(case)
        return ", ".join([self._setting(case), *(facts[key] for key in self._facts)])

    def columns(self, case: Case) -> dict[str, str]:
        """Return the columns that group the runs of a study.

        Runs are compared if they agree in ``window`` and initial state. Of these, the runs with one
        ``case`` differ only in their seeds and, if ``season`` is not empty, in the year.
        """
        window, name = self._window(case), self._setting(case, seed=False)
        return {
            "window": ", ".join(
                text for key, text in window.items() if text and key in (self._windows or window)
            ),
            "case": f"{name}, {_forecast(case, seed=False)}" if self._forecasts else name,
            "season": window["start"] if _season(case) in self._seasons else "",
        }

    def _setting(self, case: Case, *, seed: bool = True) -> str:
        """Return the controller with its parameters, and the errors of sensor and pump."""
        values, name = _values(case), case.controller.name
        shown = (key for key in self._values[name] if seed or key != "noise_seed")
        return _named(name, {key: values[key] for key in shown})

    def _window(self, case: Case) -> dict[str, str]:
        """Return the facts that runs share with those that they are compared with, in words."""
        facts = {name: _facts(case)[name] for name in _WINDOW}
        if _season(case) in self._seasons:
            start = datetime.fromisoformat(case.start)
            facts |= {"weather": "", "start": f"from {start:%d %B %H:%M}"}
        return facts


_WINDOW = ("site", "weather", "start", "hours", "evapotranspiration")


def _season(case: Case) -> tuple[object, ...]:
    """Return what a season's runs of several years have in common; its first item is the start."""
    start = datetime.fromisoformat(case.start)
    return (
        f"{start:%m-%dT%H:%M}" if case.hours >= _SEASON_HOURS else "", case.site.name, case.hours,
        case.evapotranspiration, case.initial, case.sensor_and_pump,
    )


def _values(case: Case) -> dict[str, float | str]:
    """Return the parameters of a case's controller, and the errors of its sensor and pump."""
    errors = case.sensor_and_pump
    return {**case.parameters, **({} if errors is None else errors.values())}


def _facts(case: Case) -> dict[str, str]:
    """Return the facts that can distinguish cases of one controller, in words."""
    return {
        "initial": case.initial, "start": f"from {case.start}",
        "hours": f"{format_exactly(case.hours)} h", "weather": case.weather_name,
        "site": case.site.name,
        "evapotranspiration": f"{case.evapotranspiration} evapotranspiration",
        "forecast": _forecast(case),
    }


def _forecast(case: Case, *, seed: bool = True) -> str:
    """Name the forecasts of a case."""
    options = {
        key: value for key, value in case.forecast.options().items() if seed or key != "seed"
    }
    return _named(f"forecast {case.forecast}", options)


def _named(name: str, values: Mapping[str, float | str]) -> str:
    """Return a name followed by values."""
    texts = (
        f"{key} {value if isinstance(value, str) else format_exactly(value)}"
        for key, value in values.items()
    )
    return " ".join([name, *texts])
