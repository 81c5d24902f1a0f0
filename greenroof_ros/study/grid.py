"""The grid of a study: a YAML file in which every combination of what is listed is a run."""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError
from greenroof_ros.common.files import (
    YamlMapping,
    read_yaml,
    shared_directory,
    unique_name,
)
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import (
    NUMBERS,
    OPTIONS,
    PERFECT,
    ForecastChoice,
    check_skill,
    choose,
)
from greenroof_ros.forecast.skill import SKILLS, read_skill
from greenroof_ros.formats.own_csv import write_forecasts
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.formats.records import name_files
from greenroof_ros.model.initial_state import (
    INITIAL_STATES,
    OWN_KEYS,
    SITES_OWN,
    check_volumes,
    initial_state,
    own_state,
)
from greenroof_ros.model.sensor_pump_errors import PARAMETERS, SensorPumpErrors
from greenroof_ros.model.site import PLACE, Site, edited, read_site, site_parameters
from greenroof_ros.recording.results_table import shortest
from greenroof_ros.weather.reading import find_files, read_weather
from greenroof_ros.weather.series import GAPS, REFUSE, Weather

_KEYS = ("site", "weather", "initial", "controllers")
_OPTIONAL_KEYS = ("forecast", "sensor_pump_errors", "bound_block")
# The digests of a case's files of forecasts, in what its identity is made from.
_DIGESTS = {"file": "forecast_file", "skill": "skill_file", "dressed": "dressed"}
# What the directory of a study has beside them.
_OWN_FILES = ("grid.yaml", "study.json")
# What a value of each kind must be.
_KINDS = {str: "a text", int: "a whole number", float: "a number"}
_WINDOW_KEYS = ("file", "start", "year", "hours", "evapotranspiration", "gaps", "forecast")


@dataclass(frozen=True)
class InputFile:
    """A file that runs are made from, carried along to whichever machine they run on."""

    name: str
    """unique in the study"""
    content: bytes

    @property
    def digest(self) -> str:
        """Identity of the content."""
        return hashlib.sha256(self.content).hexdigest()


@dataclass(frozen=True)
class Case:
    """One run of a study, with everything that decides its numbers.

    Attributes:
        site: site file.
        weather: weather files, joined, in the order of time.
        weather_name: one name for them, which no other weather of the study has.
        start: time of tick 0, ISO 8601 with its offset from UTC.
        hours: length (h).
        evapotranspiration: method.
        gaps: what is done about gaps in the weather files.
        forecast: which forecasts; their files by name.
        forecast_files: these, by the attribute of the choice that names each.
        controller: which.
        parameters: all of the controller's.
        initial: name of the initial state.
        cistern: initial volume (m3).
        roof: initial volume (m3).
        sensor_pump_errors: of level sensor and pumps; None where the grid does not speak of them.
        bound_block: s that share a variable of the least possible deviation; None for what is
            usual, 0 where it is not asked for.
    """

    site: InputFile
    weather: tuple[InputFile, ...]
    weather_name: str
    start: str
    hours: float
    evapotranspiration: str
    forecast: ForecastChoice
    forecast_files: Mapping[str, InputFile]
    controller: ControllerChoice
    parameters: dict[str, float]
    initial: str
    cistern: float
    roof: float
    sensor_pump_errors: SensorPumpErrors | None = None
    gaps: str = REFUSE
    bound_block: float | None = None

    @property
    def files(self) -> tuple[InputFile, ...]:
        """What it reads."""
        return self.site, *self.weather, *self.forecast_files.values()

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits, the same wherever and whenever the numbers are the same."""
        content = {
            **self.columns(),
            "site": self.site.digest,
            "weather": " ".join(file.digest for file in self.weather),
            "forecast_file": "",
            **{_DIGESTS[key]: file.digest for key, file in self.forecast_files.items()},
            "parameters": sorted(self.parameters.items()),
            "controller": [self.controller.reference, self.controller.source],
        }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    @property
    def problem(self) -> str:
        """Identity of what every controller is given alike, and of how it is bounded."""
        alike = replace(
            self, controller=find_controller("onoff"), parameters={}, forecast=ForecastChoice(),
            forecast_files={}, sensor_pump_errors=None,
        ).identity
        return alike if self.bound_block is None else f"{alike}-{shortest(self.bound_block)}"

    def columns(self) -> dict[str, Any]:
        """Return what the table says of the case itself, without its parameters."""
        return {
            "site": self.site.name,
            "weather": self.weather_name,
            "start": self.start,
            "hours": self.hours,
            "evapotranspiration": self.evapotranspiration,
            **({"gaps": self.gaps} if self.gaps != REFUSE else {}),
            "forecast": str(self.forecast),
            **{f"forecast_{name}": self.forecast.options().get(name) for name in OPTIONS},
            **(
                {} if self.forecast.dressed is None
                else {"forecast_dressed": self.forecast.dressed.name}
            ),
            **(self.sensor_pump_errors.values() if self.sensor_pump_errors is not None else {}),
            "controller": self.controller.name,
            "initial": self.initial,
            "cistern_m3": self.cistern,
            "roof_m3": self.roof,
        }


def in_directory(
    choice: ForecastChoice, files: Mapping[str, InputFile], directory: Path
) -> ForecastChoice:
    """Return a choice of forecasts whose files are those of a case, in a directory."""
    places: dict[str, Any] = {key: directory / file.name for key, file in files.items()}
    if "skill" in places:
        places["skill"] = str(places["skill"])
    return replace(choice, **places)


class _Setting(NamedTuple):
    """A controller as it is to run."""

    controller: ControllerChoice
    parameters: dict[str, float]
    """all of them on a site; of the grid those that are given"""
    forecasts: list[ForecastChoice] | None
    """instead of the grid's, for a controller that looks at none or at one kind; None for those"""
    sites: list[str]
    """files of those that it runs on; empty for all"""


def read_grid(path: Path, weather: Path | None = None) -> list[Case]:
    """Read a grid such as ``config/studies/paper.yaml`` and check every run of it.

    Args:
        path: of the grid.
        weather: directory of weather files that are not beside it, such as a record of years.

    Returns:
        The runs, in the order of the file: sites, windows, methods, forecasts, initial states,
        sensor_pump_errors, controllers with their parameters.

    Raises:
        ConfigurationError: the grid, or a file that it names, is wrong; nothing has run yet.
    """
    grid = _Grid(path, weather)
    cases = list(grid.cases())
    seen: set[str] = set()
    for case in cases:
        if case.identity in seen:
            raise ConfigurationError(
                f"is the same run twice: {case.controller.name} {case.parameters}, {case.initial}, "
                f"from {case.start}, forecast {case.forecast}"
                + (f", {case.sensor_pump_errors.values()}" if case.sensor_pump_errors else ""),
                file=path,
            )
        seen.add(case.identity)
    return cases


class _Grid:
    """A grid file while it is read."""

    def __init__(self, path: Path, weather: Path | None) -> None:
        self._path = path
        self._places = [path.parent, *([] if weather is None else [weather])]
        # Holds edited sites until they are carried along.
        self._scratch = tempfile.TemporaryDirectory(prefix="greenroof_ros-")
        self._mapping = read_yaml(path)
        self._keys(self._mapping, (*_KEYS, *_OPTIONAL_KEYS))
        for key in _KEYS:
            if not self._mapping.get(key):
                raise ConfigurationError("is missing or empty", file=path, key=key)
        self._files: dict[Path, InputFile] = {}
        self._weathers: dict[tuple[InputFile, ...], str] = {}
        self._read: dict[tuple[object, ...], Weather] = {}

    def cases(self) -> Iterator[Case]:
        """Yield every combination."""
        controllers = list(self._controllers())
        for name, path in self._sites():
            site = read_site(path)
            # Those parameters that are not given are as they are on a site.
            settings = [
                one._replace(parameters={**one.controller.defaults(site), **one.parameters})
                for one in controllers if not one.sites or name in one.sites
            ]
            for window in self._windows():
                for when in _products({
                    "start": self._list(window, "start", str),
                    "hours": self._list(window, "hours", float, [None]),
                    "method": self._list(window, "evapotranspiration", str, [None]),
                }):
                    yield from self._runs(path, site, window, settings, **when)

    def _sites(self) -> Iterator[tuple[str, Path]]:
        """Yield the name and path of each site file, those with other values with these."""
        given = self._mapping["site"]
        for number, each in enumerate(given if isinstance(given, list) else [given]):
            if isinstance(each, str):
                yield each, self._place(self._mapping, "site", each) / each
                continue
            if not isinstance(each, YamlMapping) or "file" not in each:
                raise self._refuse(
                    self._mapping, "site",
                    "must be the name of a file, {file: site.yaml, tau: 10.0, a1: [10.0, 25.0]}, "
                    "or a list of such",
                )
            symbols = [parameter.name for parameter in site_parameters()]
            self._keys(each, ("file", *symbols))
            values = {key: self._list(each, key, float) for key in each if key != "file"}
            for name in self._list(each, "file", str):
                file = self._place(each, "file", name) / name
                read_site(file)
                for own in _products(values):
                    label = "_".join(f"{key}-{shortest(value)}" for key, value in own.items())
                    path = Path(self._scratch.name, str(number), f"{file.stem}_{label}.yaml")
                    path.parent.mkdir(exist_ok=True)
                    path.write_text(edited(file, own), encoding="utf-8")
                    try:
                        read_site(path)
                    except ConfigurationError as error:  # it names the copy
                        raise ConfigurationError(
                            f"{name} with these values: {error.wrong}", file=self._path,
                            line=each.lines[next(iter(own), "file")],
                        ) from error
                    yield name, path

    def _runs(
        self, site_file: Path, site: Site, window: YamlMapping, controllers: list[_Setting], *,
        start: str, hours: float | None, method: str | None,
    ) -> Iterator[Case]:
        """Yield the runs of one site in one window."""
        files: list[Path] = []
        for name in self._list(window, "file", str):
            place = self._place(window, "file", name)
            with self._at(window, "file"):
                found = find_files([name], "file", place)
            files += [file for file in found if file not in files]
        with self._at(window, "hours"):
            steps = count_ticks(site, hours, "hours")
        gaps = REFUSE
        if "gaps" in window:
            gaps = self._one(window, "gaps", str)
            if gaps not in GAPS:
                raise self._refuse(window, "gaps", f"must be {' or '.join(GAPS)}")
        with self._at(window, "evapotranspiration"):
            weather = self._weather(files, site, method, gaps)
        # What one controller can run with, the others with the same forecasts can; and forecasts
        # with errors need the records that perfect ones do.
        checked: dict[tuple[object, ...], Run] = {}
        given = window if "forecast" in window else self._mapping
        usual = list(self._forecasts(given))
        choices = [*usual]
        for one in controllers:
            choices += [choice for choice in one.forecasts or () if choice not in choices]
        for choice, (initial, volumes) in itertools.product(
            choices, list(self._initial_states(site_file, site))
        ):
            theirs = [
                one for one in controllers
                if choice in (usual if one.forecasts is None else one.forecasts)
            ]
            for controller, parameters, *_ in theirs:
                asked = ForecastChoice() if "seed" in choice.takes else choice
                key = (asked, volumes, parameters.get("horizon"), controller.ensemble)
                if key not in checked:
                    with self._at(window, "start"):
                        checked[key] = build_run(
                            site_file, site, weather, start, steps, controller, parameters,
                            initial, volumes, asked,
                        )
                run = checked[key]
            carried, forecast_files = self._carried(choice, site)
            inputs = tuple(map(self._input, weather.files))
            for sensor_pump_errors, (controller, parameters, *_) in itertools.product(
                list(self._sensor_pump_errors()), theirs
            ):
                yield Case(
                    site=self._input(site_file, _whole_site),
                    weather=inputs,
                    weather_name=self._weather_name(inputs),
                    start=run.start.isoformat(),
                    hours=run.steps * site.tau / 3600,
                    evapotranspiration=weather.method,
                    forecast=carried,
                    forecast_files=forecast_files,
                    controller=controller,
                    parameters=parameters,
                    initial=initial,
                    cistern=run.x1,
                    roof=run.x2,
                    sensor_pump_errors=sensor_pump_errors,
                    gaps=gaps,
                    bound_block=self._bound_block(site),
                )

    def _forecasts(self, mapping: YamlMapping) -> Iterator[ForecastChoice]:
        """Yield each kind of forecast under ``forecast:`` with each combination of its options."""
        forecasts = mapping.get("forecast", PERFECT)
        if forecasts == []:
            raise self._refuse(mapping, "forecast", "is empty")
        for forecast in forecasts if isinstance(forecasts, list) else [forecasts]:
            options = forecast if isinstance(forecast, YamlMapping) else YamlMapping()
            text = options.get("model") if options else forecast
            try:
                choice = choose(str(text))
            except ValueError as error:
                raise self._refuse(
                    mapping, "forecast",
                    f"{text!r} {error}, or {{model: errors, skill: real, seed: [1, 2]}}",
                ) from error
            if choice.file is not None:
                place = self._place(mapping, "forecast", str(choice.file))
                choice = replace(choice, file=place / choice.file)
            if options:
                of_file = () if choice.file is None else ("dressed",)
                self._keys(options, ("model", *choice.takes, *of_file))
            if "dressed" in options:
                name = self._one(options, "dressed", str)
                choice = replace(choice, dressed=self._place(options, "dressed", name) / name)
            choices = {
                "skill": self._skills(options) if "skill" in options else [choice.skill],
                **{name: self._in_range(options, name, NUMBERS[name].low, NUMBERS[name].high)
                   for name in choice.takes if name in options and name in NUMBERS},
            }
            for values in _products(choices):
                yield replace(choice, **values)

    def _weather(self, files: list[Path], site: Site, method: str | None, gaps: str) -> Weather:
        """Return the weather of some files, read once for all sites of a place."""
        place = tuple(getattr(site, name) for name in PLACE)
        key = (*files, place, method, gaps)
        if key not in self._read:
            self._read[key] = read_weather(files, site, method, gaps)
        return self._read[key]

    def _skills(self, options: YamlMapping) -> list[str]:
        """Return the skills under ``skill:``, a file of one by its path."""
        skills = []
        for text in self._list(options, "skill", str):
            try:
                check_skill(text)
            except ValueError as error:
                raise self._refuse(options, "skill", f"{text!r} {error}") from error
            if text not in SKILLS:
                text = str(self._place(options, "skill", text) / text)
            with self._at(options, "skill"):
                read_skill(text)
            skills.append(text)
        return skills

    def _sensor_pump_errors(self) -> Iterator[SensorPumpErrors | None]:
        """Yield each combination of what is under ``sensor_pump_errors:``; None without it."""
        if "sensor_pump_errors" not in self._mapping:
            yield None
            return
        for mapping in self._mappings(
            "sensor_pump_errors",
            "must be {roof_noise: 0.0005, roof_offset: [0, 0.002]} and the like, or a list of such",
        ):
            self._keys(mapping, tuple(PARAMETERS))
            for values in _products({
                name: self._in_range(mapping, name, PARAMETERS[name].low, PARAMETERS[name].high)
                for name in PARAMETERS if name in mapping
            }):
                yield SensorPumpErrors(**values)

    def _mappings(self, key: str, expected: str) -> list[YamlMapping]:
        """Return what is under a key of the grid as a list of mappings; one is a list of one."""
        given = self._mapping[key]
        mappings = given if isinstance(given, list) else [given]
        if not mappings or not all(isinstance(each, YamlMapping) for each in mappings):
            raise self._refuse(self._mapping, key, expected)
        return mappings

    def _in_range(self, mapping: YamlMapping, key: str, low: float, high: float) -> list[Any]:
        """Return the values of an option with a range: whole numbers where its ends are."""
        values = self._list(mapping, key, type(low))
        for value in values:
            if not low <= value <= high:
                raise self._refuse(mapping, key, f"{value} must be from {low} to {high}")
        return values

    def _place(self, mapping: YamlMapping, key: str, name: str) -> Path:
        """Return the directory from which a name, or a pattern, names a file.

        It is the grid's own, or else the weather's, or else the package's ``config/``: a
        copy of a grid of the package runs as it is.

        Raises:
            ConfigurationError: there is no such file in any of them.
        """
        places = (*self._places, shared_directory() / "config")
        for place in places:
            if (place / name).exists() or glob.glob(str(place / name)):  # noqa: PTH207
                return place
        if Path(name).is_absolute():
            raise self._refuse(mapping, key, f"{name} does not exist")
        raise self._refuse(
            mapping, key,
            f"{name} is neither beside the grid, in {places[0].resolve()}, nor "
            + "".join(f"in --weather {place}, nor " for place in places[1:-1])
            + f"among the package's own files, in {places[-1]}",
        )

    def _input(
        self, path: Path, content: Callable[[Path], bytes] = Path.read_bytes
    ) -> InputFile:
        """Return a file's content under a name that no other file of the study has.

        It is the file's own, with its folder's before it where another file has it already.
        """
        path = path.resolve()
        if path not in self._files:
            named = path
            if named.name in self._taken():
                named = path.with_name(f"{path.parent.name}-{path.name}")
            self._files[path] = InputFile(unique_name(named, self._taken()), content(path))
        return self._files[path]

    def _taken(self) -> set[str]:
        """Return the names that files of the study have."""
        return {*_OWN_FILES, *(file.name for file in self._files.values())}

    def _carried(
        self, choice: ForecastChoice, site: Site
    ) -> tuple[ForecastChoice, dict[str, InputFile]]:
        """Return a choice of forecasts as the study carries it along, and its files.

        A directory is one file there, in the project's own form, and so is NetCDF, whose name has
        to say its issue alone.
        """
        path = None if choice.file is None else choice.file.resolve()
        if path is not None and (path.is_dir() or path.suffix.lower() == ".nc"):
            archive = read_archive(path, site, choice.delay)
            choice = replace(choice, delay=archive.delay)
            if path not in self._files:
                name = unique_name(Path(f"{path.name}.csv"), self._taken())
                self._files[path] = InputFile(name, write_forecasts(archive.issues).encode())
        named = {"file": path, "skill": choice.skill_file, "dressed": choice.dressed}
        files = {key: self._input(file) for key, file in named.items() if file is not None}
        return in_directory(choice, files, Path()), files

    def _weather_name(self, files: tuple[InputFile, ...]) -> str:
        """Return one name for weather files, which no others of the study have."""
        if files not in self._weathers:
            name = name_files([Path(file.name) for file in files])
            taken = self._weathers.values()
            alike = itertools.chain([name], (f"{name} ({n})" for n in itertools.count(2)))
            self._weathers[files] = next(each for each in alike if each not in taken)
        return self._weathers[files]

    def _windows(self) -> Iterator[YamlMapping]:
        for window in self._mappings(
            "weather", "must be a list of windows, each with 'file:', 'start:' and 'hours:'"
        ):
            self._keys(window, _WINDOW_KEYS)
            for key in ("file", "start"):
                if key not in window:
                    raise ConfigurationError(
                        "is missing in a window of 'weather:'", file=self._path, key=key
                    )
            if "year" not in window:
                yield window
                continue
            for year in self._list(window, "year", int):
                of_year = YamlMapping({
                    **window,
                    **{key: [text.replace("{year}", str(year))
                             for text in self._list(window, key, str)]
                       for key in ("file", "start")},
                })
                of_year.lines = window.lines
                yield of_year

    def _initial_states(
        self, site_file: Path, site: Site
    ) -> Iterator[tuple[str, tuple[float, float]]]:
        states = self._mapping["initial"]
        names = set()
        for state in states if isinstance(states, list) else [states]:
            if isinstance(state, YamlMapping):
                areas = {"cistern": site.a1, "roof": site.a2}
                self._keys(state, ("name", *areas, *(f"{key}_level" for key in areas)))
                lacking = ["name"] * ("name" not in state) + [
                    key for key in areas if (key in state) == (f"{key}_level" in state)
                ]
                if lacking:
                    raise self._refuse(
                        self._mapping, "initial",
                        f"a state has no {' and no '.join(lacking)}, or two of one",
                    )
                name = self._one(state, "name", str)
                volumes = tuple(
                    self._one(state, key, float) if key in state
                    else self._one(state, f"{key}_level", float) * area
                    for key, area in areas.items()
                )
                if min(volumes) < 0:
                    raise self._refuse(self._mapping, "initial", "volumes must not be negative")
            else:
                name = state
                if not isinstance(name, str) or name not in (*INITIAL_STATES, SITES_OWN):
                    raise self._refuse(
                        self._mapping, "initial",
                        f"{name!r} must be one of {', '.join((*INITIAL_STATES, SITES_OWN))}, or "
                        "{name: dry, cistern: 60.0, roof: 1.0} in m3",
                    )
                own = own_state(site)
                if name != SITES_OWN:
                    volumes = initial_state(site, name)
                elif own is not None:
                    volumes = own
                else:
                    raise self._refuse(
                        self._mapping, "initial",
                        f"{SITES_OWN} needs {' and '.join(OWN_KEYS)} in {site_file.name}",
                    )
            if name in names:
                raise self._refuse(self._mapping, "initial", f"has {name} twice")
            names.add(name)
            with self._at(self._mapping, "initial"):
                check_volumes(site, volumes[0], volumes[1], keys=("cistern", "roof"))
            yield name, (volumes[0], volumes[1])

    def _bound_block(self, site: Site) -> float | None:
        """Return what is under ``bound_block:``, whole ticks of a site or 0; None without it."""
        if "bound_block" not in self._mapping:
            return None
        seconds = float(self._one(self._mapping, "bound_block", float))
        ticks = round(seconds / site.tau) if math.isfinite(seconds) else -1
        if ticks < 0 or not math.isclose(ticks * site.tau, seconds, rel_tol=1e-9, abs_tol=1e-9):
            raise self._refuse(
                self._mapping, "bound_block",
                f"must be a whole number of ticks of {site.tau:g} s, or 0 for no bound",
            )
        return seconds if ticks else 0.0

    def _controllers(self) -> Iterator[_Setting]:
        """Yield each controller with each combination of its parameters."""
        section = self._mapping["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(
                self._mapping, "controllers", "must hold 'mpc:' or other controllers"
            )
        references: dict[str, str] = {}
        for reference in section:
            with self._at(section, reference):
                controller = find_controller(reference)
            if controller.name in references:
                raise self._refuse(
                    section, reference,
                    f"is named {controller.name}, as {references[controller.name]} is; rename its "
                    "class",
                )
            references[controller.name] = reference
            given = YamlMapping() if section[reference] is None else section[reference]
            for one in given if isinstance(given, list) and given else [given]:
                if not isinstance(one, YamlMapping):
                    raise self._refuse(
                        section, reference, "must hold parameters, a list of such, or nothing"
                    )
                yield from self._settings(controller, one)

    def _settings(
        self, controller: ControllerChoice, given: YamlMapping
    ) -> Iterator[_Setting]:
        """Yield a controller with each combination of the parameters that are given."""
        forecasts = list(self._forecasts(given)) if "forecast" in given else None
        sites = self._list(given, "site", str) if "site" in given else []
        for name in sites:
            if name not in (known for known, _ in self._sites()):
                raise self._refuse(given, "site", f"{name} is not under 'site:' of the grid")
        keys = [key for key in given if key not in ("forecast", "site")]
        choices = {}
        for key in keys:
            controller.check_name(key, self._path, given.lines[key])
            parameter = controller.parameters[key]
            values = self._list(given, key, float)
            for value in values:
                if not parameter.accepts(value):
                    raise self._refuse(given, key, f"{value:g} {parameter.expected}")
            choices[key] = [int(value) if parameter.whole else value for value in values]
        for parameters in _products(choices):
            yield _Setting(controller, parameters, forecasts, sites)

    @contextmanager
    def _at(self, mapping: YamlMapping, key: str) -> Iterator[None]:
        """Say in which line of the grid a mistake is that shows elsewhere."""
        try:
            yield
        except ConfigurationError as error:
            line = mapping.lines.get(key, min(mapping.lines.values()))
            raise ConfigurationError(str(error), file=self._path, line=line) from error

    def _one(self, mapping: YamlMapping, key: str, kind: type) -> Any:
        """Return a value that must be one, not a list."""
        if isinstance(mapping[key], list):
            raise self._refuse(mapping, key, "must be one value, not a list")
        return self._list(mapping, key, kind)[0]

    def _list(
        self, mapping: YamlMapping, key: str, kind: type, default: list[Any] | None = None
    ) -> list[Any]:
        """Return a value as a list of a kind, str, float or int; one value is a list of one.

        Whole numbers may be given as ``{from: 1, to: 50}``.
        """
        if key not in mapping and default is not None:
            return default
        value = mapping[key]
        if kind is int and isinstance(value, YamlMapping):
            self._keys(value, ("from", "to"))
            if value.keys() != {"from", "to"}:
                raise self._refuse(mapping, key, "must be {from: 1, to: 50} or the like")
            value = list(range(
                self._one(value, "from", int), self._one(value, "to", int) + 1
            ))
        values = value if isinstance(value, list) else [value]
        if not values:
            raise self._refuse(mapping, key, "is empty")
        expected: Any = (int, float) if kind is float else kind
        for each in values:
            if isinstance(each, bool) or not isinstance(each, expected):
                raise self._refuse(mapping, key, f"must be {_KINDS[kind]}, or a list of them")
            if kind is float and math.isnan(each):
                raise self._refuse(mapping, key, "must not be nan")
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


def _products(choices: Mapping[str, list[Any]]) -> Iterator[dict[str, Any]]:
    """Yield every combination of the values of some options."""
    for combination in itertools.product(*choices.values()):
        yield dict(zip(choices, combination, strict=True))


def _whole_site(path: Path) -> bytes:
    return edited(path, {}).encode()
