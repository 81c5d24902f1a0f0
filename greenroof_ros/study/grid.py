"""The grid of a study: a YAML file in which every combination of what is listed is a run."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from greenroof_ros.errors import ConfigurationError
from greenroof_ros.files import YamlMapping, read_yaml, shared_directory
from greenroof_ros.run import (
    CONTROLLERS,
    INITIAL_STATES,
    build_run,
    count_ticks,
    initial_state,
    read_parameters,
)
from greenroof_ros.site import Site, read_site
from greenroof_ros.weather import read_weather

_KEYS = ("site", "weather", "initial", "controllers")
_WINDOW_KEYS = ("file", "start", "hours", "evapotranspiration")


@dataclass(frozen=True)
class InputFile:
    """A file that runs are made from, carried along to whichever machine they run on."""

    name: str
    """unique in the study"""
    content: bytes


@dataclass(frozen=True)
class Case:
    """One run of a study, with everything that decides its numbers.

    Attributes:
        site: site file.
        weather: weather file.
        start: time of tick 0, ISO 8601 with its offset from UTC.
        hours: length (h).
        evapotranspiration: variant.
        controller: its name.
        parameters: all of the controller's.
        initial: name of the initial state.
        cistern: initial volume (m3).
        roof: initial volume (m3).
    """

    site: InputFile
    weather: InputFile
    start: str
    hours: float
    evapotranspiration: str
    controller: str
    parameters: dict[str, float]
    initial: str
    cistern: float
    roof: float

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits, the same wherever and whenever the numbers are the same."""
        content = {
            **self.columns(),
            "site": hashlib.sha256(self.site.content).hexdigest(),
            "weather": hashlib.sha256(self.weather.content).hexdigest(),
            "parameters": sorted(self.parameters.items()),
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    def columns(self) -> dict[str, Any]:
        """Return what the table says of the case itself, without its parameters."""
        return {
            "site": self.site.name,
            "weather": self.weather.name,
            "start": self.start,
            "hours": self.hours,
            "evapotranspiration": self.evapotranspiration,
            "controller": self.controller,
            "initial": self.initial,
            "cistern_m3": self.cistern,
            "roof_m3": self.roof,
        }


def read_grid(path: Path) -> list[Case]:
    """Read a grid such as ``config/study.yaml`` and check every run of it.

    Returns:
        The runs, in the order of the file: windows, variants, initial states, controllers with
        their parameters.

    Raises:
        ConfigurationError: the grid, or a file that it names, is wrong; nothing has run yet.
    """
    grid = _Grid(path)
    cases = list(grid.cases())
    seen: set[str] = set()
    for case in cases:
        if case.identity in seen:
            raise ConfigurationError(
                f"is the same run twice: {case.controller} {case.parameters}, {case.initial}, "
                f"from {case.start}",
                file=path,
            )
        seen.add(case.identity)
    return cases


class _Grid:
    """A grid file while it is read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._mapping = read_yaml(path)
        self._keys(self._mapping, _KEYS)
        for key in _KEYS:
            if not self._mapping.get(key):
                raise ConfigurationError("is missing or empty", file=path, key=key)
        self._files: dict[Path, InputFile] = {}

    def cases(self) -> Iterator[Case]:
        """Yield every combination."""
        controllers = list(self._controllers())
        for site_file in self._list(self._mapping, "site", str):
            path = self._path.parent / site_file
            site = read_site(path)
            for window in self._windows():
                for start, variant in itertools.product(
                    self._list(window, "start", str),
                    self._list(window, "evapotranspiration", str, [None]),
                ):
                    yield from self._runs(path, site, window, start, variant, controllers)

    def _runs(
        self,
        site_file: Path,
        site: Site,
        window: YamlMapping,
        start: str,
        variant: str | None,
        controllers: list[tuple[str, dict[str, float]]],
    ) -> Iterator[Case]:
        """Yield the runs of one site in one window."""
        (file,) = self._list(window, "file", str)
        (hours,) = self._list(window, "hours", float, [None])
        steps = count_ticks(site, hours, "hours")
        weather = read_weather(self._path.parent / file, site, variant)
        for initial, volumes in self._initial_states(site):
            # The same for each controller: one check is enough.
            name, parameters = controllers[0]
            run = build_run(
                site_file, site, weather, start, steps, name, parameters, initial, volumes
            )
            for name, parameters in controllers:
                yield Case(
                    site=self._input(site_file),
                    weather=self._input(weather.file),
                    start=run.start.isoformat(),
                    hours=run.steps * site.tau / 3600,
                    evapotranspiration=weather.variant,
                    controller=name,
                    parameters=parameters,
                    initial=initial,
                    cistern=run.x1,
                    roof=run.x2,
                )

    def _input(self, path: Path) -> InputFile:
        """Return a file's content under a name that no other file of the study has."""
        path = path.resolve()
        if path not in self._files:
            taken = {file.name for file in self._files.values()}
            name, number = path.name, 1
            while name in taken:
                number += 1
                name = f"{path.stem}-{number}{path.suffix}"
            self._files[path] = InputFile(name, path.read_bytes())
        return self._files[path]

    def _windows(self) -> Iterator[YamlMapping]:
        windows = self._mapping["weather"]
        for window in windows if isinstance(windows, list) else [windows]:
            if not isinstance(window, YamlMapping):
                raise self._refuse(
                    self._mapping, "weather", "must be a list of windows, each with 'file:', "
                    "'start:' and 'hours:'",
                )
            self._keys(window, _WINDOW_KEYS)
            for key in ("file", "start"):
                if key not in window:
                    raise ConfigurationError(
                        "is missing in a window of 'weather:'", file=self._path, key=key
                    )
            yield window

    def _initial_states(self, site: Site) -> Iterator[tuple[str, tuple[float, float]]]:
        states = self._mapping["initial"]
        names = set()
        for state in states if isinstance(states, list) else [states]:
            if isinstance(state, YamlMapping):
                self._keys(state, ("name", "cistern", "roof"))
                lacking = {"name", "cistern", "roof"} - state.keys()
                if lacking:
                    raise self._refuse(
                        self._mapping, "initial", f"a state has no {', '.join(sorted(lacking))}"
                    )
                (name,) = self._list(state, "name", str)
                volumes = tuple(self._list(state, key, float)[0] for key in ("cistern", "roof"))
                if min(volumes) < 0:
                    raise self._refuse(self._mapping, "initial", "volumes must not be negative")
            else:
                name = state
                if name not in INITIAL_STATES:
                    raise self._refuse(
                        self._mapping, "initial",
                        f"{name!r} must be one of {', '.join(INITIAL_STATES)}, or "
                        "{name: dry, cistern: 60.0, roof: 1.0} in m3",
                    )
                volumes = initial_state(site, name)
            if name in names:
                raise self._refuse(self._mapping, "initial", f"has {name} twice")
            names.add(name)
            yield name, (volumes[0], volumes[1])

    def _controllers(self) -> Iterator[tuple[str, dict[str, float]]]:
        """Yield each controller with each combination of its parameters."""
        section = self._mapping["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(
                self._mapping, "controllers", "must hold 'mpc:' or other controllers"
            )
        self._keys(section, tuple(CONTROLLERS))
        for name in section:
            defaults = read_parameters(shared_directory() / "config" / f"{name}.yaml", name)
            given = section[name]
            if given is None:
                yield name, defaults
                continue
            if not isinstance(given, YamlMapping):
                raise self._refuse(section, name, "must hold parameters, or nothing")
            self._keys(given, tuple(CONTROLLERS[name]))
            choices = []
            for key in given:
                low, high = CONTROLLERS[name][key]
                values = self._list(given, key, float)
                for value in values:
                    if not low <= value <= high:
                        raise self._refuse(
                            given, key, f"{value:g} must be from {low:g} to {high:g}"
                        )
                choices.append(values)
            for combination in itertools.product(*choices):
                yield name, {**defaults, **dict(zip(given, combination, strict=True))}

    def _list(
        self, mapping: YamlMapping, key: str, kind: type, default: list[Any] | None = None
    ) -> list[Any]:
        """Return a value as a list of a kind, str or float; one value is a list of one."""
        if key not in mapping and default is not None:
            return default
        value = mapping[key]
        values = value if isinstance(value, list) else [value]
        if not values:
            raise self._refuse(mapping, key, "is empty")
        for each in values:
            is_number = isinstance(each, (int, float)) and not isinstance(each, bool)
            if kind is float and not is_number:
                raise self._refuse(mapping, key, "must be a number, or a list of them")
            if kind is float and math.isnan(each):
                raise self._refuse(mapping, key, "must not be nan")
            if kind is str and not isinstance(each, str):
                raise self._refuse(mapping, key, "must be a text, or a list of them")
        return [kind(each) for each in values]

    def _keys(self, mapping: YamlMapping, known: tuple[str, ...]) -> None:
        for key, line in mapping.lines.items():
            if key not in known:
                raise ConfigurationError(
                    f"is not known here; there are {', '.join(known)}",
                    file=self._path, line=line, key=key,
                )

    def _refuse(self, mapping: YamlMapping, key: str, expected: str) -> ConfigurationError:
        return ConfigurationError(
            expected, file=self._path, line=mapping.lines[key], key=key,
            value=None if isinstance(mapping[key], (dict, list)) else mapping[key],
        )

