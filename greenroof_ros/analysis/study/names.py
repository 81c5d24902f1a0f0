"""Names of a study's runs, based on their differences, and the groups that a report compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greenroof_ros.analysis.study.case import Case
from greenroof_ros.results.table import find_differing_keys, format_exactly

_SEASON_HOURS = 168
"""minimum length of a season (h); shorter runs are none, even if they start on the same day of
several years"""


class Names:
    """Names of a study's cases: the controller, and the properties in which the cases differ."""

    def __init__(self, cases: Sequence[Case]) -> None:
        """Find the differences between all cases, and between the cases of each controller."""
        self._forecasts = len({_name_forecast(case) for case in cases}) > 1
        self._values = {
            name: find_differing_keys(
                [_read_values(case) for case in cases if case.controller == name]
            )
            for name in {case.controller for case in cases}
        }
        years: dict[tuple[object, ...], set[int]] = {}
        for case in cases:
            years.setdefault(_find_season(case), set()).add(case.start.year)
        self._seasons = {
            season for season, of_season in years.items() if season[0] and len(of_season) > 1
        }
        self._windows = find_differing_keys([self._name_window(case) for case in cases])

    def columns(self, case: Case) -> dict[str, str]:
        """Return the columns that group the runs of a study.

        Runs with the same ``window`` and initial state are compared. Among these, runs with the
        same ``case`` differ only in their seeds and, if ``season`` is not empty, in the year.
        """
        window, values = self._name_window(case), _read_values(case)
        # All parameters in which the cases differ, also of sensor and pumps, without seeds.
        shown = (key for key in self._values[case.controller] if key != "noise_seed")
        name = _add_values(case.controller, {key: values[key] for key in shown})
        return {
            "window": ", ".join(
                text for key, text in window.items() if text and key in (self._windows or window)
            ),
            "case": f"{name}, {_name_forecast(case)}" if self._forecasts else name,
            "season": window["start"] if _find_season(case) in self._seasons else "",
        }

    def _name_window(self, case: Case) -> dict[str, str]:
        """Return, in words, the properties shared by a run and the runs compared with it."""
        facts = {
            "site": case.site.name, "weather": case.weather_name,
            "start": f"from {case.inputs.start}", "hours": f"{format_exactly(case.hours)} h",
            "evapotranspiration": f"{case.inputs.evapotranspiration} evapotranspiration",
        }
        if _find_season(case) in self._seasons:
            facts |= {"weather": "", "start": f"from {case.start:%d %B %H:%M}"}
        return facts


def _find_season(case: Case) -> tuple[object, ...]:
    """Return the values that the runs of a season share in all years; the first is the start."""
    inputs = case.inputs
    return (
        f"{case.start:%m-%dT%H:%M}" if case.hours >= _SEASON_HOURS else "", case.site.name,
        case.hours, inputs.evapotranspiration, inputs.initial, inputs.sensor_and_pump,
    )


def _read_values(case: Case) -> dict[str, float | str]:
    """Return the parameters of a case's controller, and the errors of its sensor and pump."""
    return {**case.inputs.parameters, **case.inputs.sensor_and_pump.values()}


def _name_forecast(case: Case) -> str:
    """Return a name for the forecasts of a case, without their seed."""
    choice = case.inputs.forecast
    options = {key: value for key, value in choice.options().items() if key != "seed"}
    return _add_values(f"forecast {choice}", options)


def _add_values(name: str, values: Mapping[str, float | str]) -> str:
    """Return a name followed by its values."""
    texts = (
        f"{key} {value if isinstance(value, str) else format_exactly(value)}"
        for key, value in values.items()
    )
    return " ".join([name, *texts])
