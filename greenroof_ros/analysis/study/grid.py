"""The grid of a study: a YAML file with lists of values; every combination is a run."""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.common.errors import ConfigurationError, suggest_names
from greenroof_ros.common.files import (
    YamlMapping,
    read_yaml,
    shared_directory,
    unique_name,
)
from greenroof_ros.common.ranges import Range
from greenroof_ros.controllers.registry import (
    ControllerChoice,
    controller_names,
    find_controller,
    read_numbers,
)
from greenroof_ros.experiment.run import Run, build_run, count_ticks
from greenroof_ros.forecast.choice import (
    MODELS,
    NUMBERS,
    OPTIONS,
    ForecastChoice,
    check_skill,
    choose,
)
from greenroof_ros.forecast.skill import SKILLS, read_skill
from greenroof_ros.formats.hourly import name_files
from greenroof_ros.formats.own_csv import write_forecasts
from greenroof_ros.formats.reading import read_archive
from greenroof_ros.model.initial_state import (
    INITIAL_STATES,
    SITE_STATE,
    SITE_STATE_KEYS,
    check_volumes,
    initial_state,
    site_state,
)
from greenroof_ros.model.sensor_and_pump import PARAMETERS, SensorAndPump
from greenroof_ros.model.site import PLACE, Site, edited, read_site, site_parameters
from greenroof_ros.recording.results_table import format_exactly
from greenroof_ros.weather.evapotranspiration import COMPUTED
from greenroof_ros.weather.reading import find_files, read_weather
from greenroof_ros.weather.series import GAPS, REFUSE, Weather

_OPTIONAL_KEYS = ("forecast", "sensor_and_pump", "bound_block")
# The keys of a window with lists that multiply the runs.
_TIMES = ("year", "start", "hours", "evapotranspiration")
# Error messages that state what each block must be.
_SITE = (
    "must be the name of a file, {file: site.yaml, tau: 10.0, a1: [10.0, 25.0]}, or a list of these"
)
_WINDOW = "must be a list of windows, each with 'file:', 'start:' and 'hours:'"
_FORECAST = "{model: errors, skill: real, seed: [1, 2]}"
_FORECASTS = f"must be one of {', '.join(MODELS)}, a file or directory of forecasts, or {_FORECAST}"
_ERRORS = "must be {roof_noise: 0.0005, roof_offset: [0, 0.002]} and the like, or a list of these"
_STATE = (
    f"must be one of {', '.join((*INITIAL_STATES, SITE_STATE))}, or "
    "{name: dry, cistern: 60.0, roof: 1.0} in m3"
)
_CONTROLLERS = (
    f"must hold controllers, each with its parameters: {', '.join(controller_names())}, or "
    "package.module:Class"
)
_ANY = Range()
_FILE, _START = "must be the name of a file", "must be a time such as 2021-07-07T02:00"
_NAME = "must be a name that you choose"
_TEXTS = {
    "file": _FILE, "start": _START, "name": _NAME,
    "evapotranspiration":
        f"must be {', '.join(COMPUTED)}, or published for the weather files' own column",
    "skill": f"must be one of {', '.join(SKILLS)}, or the name of a file",
}
_SETTINGS = "must hold parameters, a list of these, or nothing"
# The keys that a grid needs, with what each must be.
_NEEDED = {"site": _SITE, "weather": _WINDOW, "initial": _STATE, "controllers": _CONTROLLERS}
# Keys for the digests of a case's forecast files in the data of its identity.
_DIGESTS = {"file": "forecast_file", "skill": "skill_file"}
# Names that the directory of a study uses itself.
_STUDY_FILES = ("grid.yaml", "study.json")


@dataclass(frozen=True)
class InputFile:
    """An input file of runs. The content is sent to each worker once, and not with each case."""

    name: str
    """unique in the study"""
    content: bytes

    def __getstate__(self) -> dict[str, str]:
        """Return what a worker gets with a case: the name."""
        return {"name": self.name}

    @property
    def digest(self) -> str:
        """Digest of the content."""
        return hashlib.sha256(self.content).hexdigest()


@dataclass(frozen=True)
class Case:
    """One run of a study, with everything that affects its numbers.

    Attributes:
        site: site file.
        weather: weather files, in the order of time, to be joined.
        weather_name: one name for them, unique in the study.
        start: time of tick 0, ISO 8601 with its offset from UTC.
        hours: length (h).
        evapotranspiration: method.
        gaps: how gaps in the weather files are treated.
        forecast: choice of forecasts, with the names of their files.
        forecast_files: these files, by the attribute of the choice that names them.
        controller: choice of the controller.
        parameters: all parameters of the controller.
        initial: name of the initial state.
        cistern: initial volume (m3).
        roof: initial volume (m3).
        sensor_and_pump: level sensor and pumps; None if the grid does not mention them.
        bound_block: time (s) that shares a variable when the minimum possible deviation is
            computed; None for the default, 0 to compute no bound.
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
    sensor_and_pump: SensorAndPump | None = None
    gaps: str = REFUSE
    bound_block: float | None = None

    @property
    def files(self) -> tuple[InputFile, ...]:
        """All input files."""
        return self.site, *self.weather, *self.forecast_files.values()

    @property
    def identity(self) -> str:
        """Twelve hexadecimal digits, the same for equal cases on any machine at any time."""
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
        """Identity of the inputs that do not depend on the controller, and of the bound's block."""
        alike = replace(
            self, controller=find_controller("onoff"), parameters={}, forecast=ForecastChoice(),
            forecast_files={}, sensor_and_pump=None,
        ).identity
        return alike if self.bound_block is None else f"{alike}-{format_exactly(self.bound_block)}"

    def columns(self) -> dict[str, Any]:
        """Return the columns of the table that describe the case, without its parameters."""
        return {
            "site": self.site.name,
            "weather": self.weather_name,
            "start": self.start,
            "hours": self.hours,
            "evapotranspiration": self.evapotranspiration,
            **({"gaps": self.gaps} if self.gaps != REFUSE else {}),
            "forecast": str(self.forecast),
            **{f"forecast_{name}": self.forecast.options().get(name) for name in OPTIONS},
            **(self.sensor_and_pump.values() if self.sensor_and_pump is not None else {}),
            "controller": self.controller.name,
            "initial": self.initial,
            "cistern_m3": self.cistern,
            "roof_m3": self.roof,
        }


def contents(cases: Iterable[Case]) -> dict[str, bytes]:
    """Return the contents of all input files of cases, by name."""
    return {file.name: file.content for case in cases for file in case.files}


def in_directory(
    choice: ForecastChoice, files: Mapping[str, InputFile], directory: Path
) -> ForecastChoice:
    """Return a choice of forecasts with a case's files in a directory."""
    places: dict[str, Any] = {key: directory / file.name for key, file in files.items()}
    if "skill" in places:
        places["skill"] = str(places["skill"])
    return replace(choice, **places)


class _Setting(NamedTuple):
    """A controller with its parameters, and the forecasts and sites that it runs with."""

    controller: ControllerChoice
    parameters: dict[str, float]
    """those in the grid; completed with defaults once the site is known"""
    forecasts: list[ForecastChoice] | None
    """its own instead of the grid's, for instance if it uses none; None for the grid's"""
    sites: list[str]
    """names of the site files that it runs on; empty for all"""


def read_grid(path: Path, weather: Path | None = None) -> list[Case]:
    """Read a grid such as ``config/studies/paper.yaml`` and check every run in it.

    Args:
        path: of the grid.
        weather: directory of weather files that are not next to the grid.

    Returns:
        The runs, in the order of the file: sites, windows, methods, forecasts, initial states,
        sensor_and_pump, controllers with their parameters.

    Raises:
        ConfigurationError: the grid, or a file that it names, is wrong. Nothing has run yet.
    """
    grid = _Grid(path, weather)
    cases = list(grid.cases())
    identities: set[str] = set()
    for case in cases:
        if case.identity in identities:
            raise ConfigurationError(
                f"is the same run twice: {case.controller.name} {case.parameters}, {case.initial}, "
                f"from {case.start}, forecast {case.forecast}"
                + (f", {case.sensor_and_pump.values()}" if case.sensor_and_pump else ""),
                file=path,
            )
        identities.add(case.identity)
    return cases


class _Grid:
    """A grid file while it is read.

    Each block is a mapping or a list of mappings; every list in a mapping multiplies the runs.
    """

    def __init__(self, path: Path, weather: Path | None) -> None:
        self._path = path
        self._places = [path.parent, *([] if weather is None else [weather])]
        # Holds edited sites until their content is read.
        self._scratch = tempfile.TemporaryDirectory(prefix="greenroof_ros-")
        self._mapping = read_yaml(path)
        self._keys(self._mapping, _NEEDED, _OPTIONAL_KEYS)
        self._files: dict[Path, InputFile] = {}
        self._weathers: dict[tuple[InputFile, ...], str] = {}
        self._read: dict[tuple[object, ...], Weather] = {}

    def cases(self) -> Iterator[Case]:
        sites = list(self._sites())
        controllers = list(self._controllers([name for name, _ in sites]))
        for name, path in sites:
            site = read_site(path)
            # Defaults of the other parameters can depend on the site.
            settings = [
                setting._replace(
                    parameters={**setting.controller.defaults(site), **setting.parameters}
                )
                for setting in controllers if not setting.sites or name in setting.sites
            ]
            for block in self._blocks(self._mapping, "weather", _WINDOW):
                self._keys(block, {"file": _FILE, "start": _START}, (*_TIMES, "gaps", "forecast"))
                for window in self._combinations(block, _TIMES):
                    yield from self._runs(path, site, window, settings)

    def _sites(self) -> Iterator[tuple[str, Path]]:
        """Yield the name and path of each site file, or of a copy with the grid's values."""
        symbols = [parameter.name for parameter in site_parameters()]
        for place, block in enumerate(self._blocks(self._mapping, "site", _SITE)):
            key = "site" if "site" in block else "file"
            self._keys(block, {key: _FILE}, symbols)
            for values in self._combinations(block, dict.fromkeys([key, *block])):
                path = file = self._file(values, key)
                own = {name: self._number(values, name) for name in values if name != key}
                read_site(file)
                if own:
                    label = "_".join(
                        f"{name}-{format_exactly(value)}" for name, value in own.items()
                    )
                    path = Path(self._scratch.name, str(place), f"{file.stem}_{label}.yaml")
                    path.parent.mkdir(exist_ok=True)
                    path.write_text(edited(file, own), encoding="utf-8")
                    with self._at(values, next(iter(own)), f"{values[key]} with these values: "):
                        read_site(path)
                yield values[key], path

    def _runs(
        self, site_file: Path, site: Site, window: YamlMapping, controllers: list[_Setting]
    ) -> Iterator[Case]:
        def of_year(text: str) -> str:
            return text.replace("{year}", str(window["year"])) if "year" in window else text

        files: list[Path] = []
        for named in self._combinations(window, ["file"]):
            name = of_year(self._text(named, "file"))
            place = self._place(window, "file", name)
            with self._at(window, "file"):
                files += find_files([name], "file", place)
        hours = self._number(window, "hours") if "hours" in window else None
        with self._at(window, "hours"):
            steps = count_ticks(site, hours, "hours")
        gaps = window.get("gaps", REFUSE)
        if gaps not in GAPS:
            raise self._refuse(window, "gaps", f"must be {' or '.join(GAPS)}")
        what = "evapotranspiration"
        method = self._text(window, what) if what in window else None
        with self._at(window, what):
            weather = self._weather(tuple(dict.fromkeys(files)), site, method, gaps)
        start = of_year(self._text(window, "start"))
        inputs = tuple(map(self._input, weather.files))
        name = name_files([Path(file.name) for file in inputs])
        self._weathers.setdefault(inputs, unique_name(Path(name), self._weathers.values()))
        # One check serves all controllers with equal forecasts and horizon. Forecasts with errors
        # need the same records as perfect ones.
        checked: dict[tuple[object, ...], Run] = {}
        usual = list(self._forecasts(window if "forecast" in window else self._mapping))
        forecasts = [
            usual if setting.forecasts is None else setting.forecasts for setting in controllers
        ]
        own = itertools.chain(*forecasts)
        for choice, (initial, volumes) in itertools.product(
            # Duplicates in `usual` are kept, so that read_grid() refuses the second run.
            [*usual, *(choice for choice in dict.fromkeys(own) if choice not in usual)],
            list(self._initial_states(site_file, site)),
        ):
            theirs = [
                setting for setting, given in zip(controllers, forecasts, strict=True)
                if choice in given
            ]
            for controller, parameters, *_ in theirs:
                seedless = ForecastChoice() if "seed" in choice.option_names else choice
                key = (seedless, volumes, parameters.get("horizon"), controller.ensemble)
                if key not in checked:
                    with self._at(window, "start"):
                        checked[key] = build_run(
                            site_file, site, weather, start, steps, controller, parameters,
                            initial, volumes, seedless,
                        )
                run = checked[key]
            carried, forecast_files = self._carried(choice, site)
            for sensor_and_pump, (controller, parameters, *_) in itertools.product(
                list(self._sensor_and_pump()), theirs
            ):
                yield Case(
                    site=self._input(site_file, lambda path: edited(path, {}).encode()),
                    weather=inputs,
                    weather_name=self._weathers[inputs],
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
                    sensor_and_pump=sensor_and_pump,
                    gaps=gaps,
                    bound_block=self._bound_block(site),
                )

    def _forecasts(self, mapping: YamlMapping) -> Iterator[ForecastChoice]:
        """Yield each forecast under ``forecast:`` with each combination of its options."""
        if "forecast" not in mapping:
            yield ForecastChoice()
            return
        for block in self._blocks(mapping, "forecast", _FORECASTS):
            key = "model" if "model" in block else "forecast"
            text = block.get(key)
            try:
                choice = choose(str(text), "forecast")
            except ConfigurationError as error:
                wrong = f"{text!r} {error.expected}, or {_FORECAST}"
                raise self._refuse(mapping, "forecast", wrong) from error
            if choice.file is not None:
                choice = replace(choice, file=self._file(block, key))
            self._keys(block, {key: _FORECAST}, choice.option_names)
            for options in self._combinations(block, choice.option_names):
                given: dict[str, Any] = read_numbers(self._path, options, NUMBERS)
                if "skill" in options:
                    given["skill"] = self._skill(options)
                yield replace(choice, **given)

    def _weather(
        self, files: tuple[Path, ...], site: Site, method: str | None, gaps: str
    ) -> Weather:
        """Return the weather of some files, which is read once for all sites at one place."""
        key = (files, *(getattr(site, name) for name in PLACE), method, gaps)
        if key not in self._read:
            self._read[key] = read_weather(files, site, method, gaps)
        return self._read[key]

    def _skill(self, options: YamlMapping) -> str:
        """Return the skill under ``skill:``, or the path of its file."""
        text = self._text(options, "skill")
        with self._at(options, "skill"):
            check_skill(text, "skill")
        if text not in SKILLS:
            text = str(self._file(options, "skill"))
        with self._at(options, "skill"):
            read_skill(text)
        return text

    def _sensor_and_pump(self) -> Iterator[SensorAndPump | None]:
        """Yield each combination under ``sensor_and_pump:``; None if there is no such key."""
        key = "sensor_and_pump"
        if key not in self._mapping:
            yield None
            return
        for block in self._blocks(self._mapping, key, _ERRORS):
            self._keys(block, {}, PARAMETERS)
            for values in self._combinations(block, PARAMETERS):
                yield SensorAndPump(**read_numbers(self._path, values, PARAMETERS))

    def _file(self, mapping: YamlMapping, key: str) -> Path:
        name = self._text(mapping, key)
        return self._place(mapping, key, name) / name

    def _place(self, mapping: YamlMapping, key: str, name: str) -> Path:
        """Return the first directory that has a file of this name or pattern.

        The order is the grid's own, the weather's, and the package's ``config/``, so that a copy of
        the package's grids runs unchanged.

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
            f"{name} is neither next to the grid, in {places[0].resolve()}, nor "
            + "".join(f"in --weather {place}, nor " for place in places[1:-1])
            + f"among the package's own files, in {places[-1]}",
        )

    def _input(
        self, path: Path, content: Callable[[Path], bytes] = Path.read_bytes, suffix: str = ""
    ) -> InputFile:
        """Return a file's content under a name that is unique in the study.

        It is the file's own name, with the folder's name in front if another file has that name.
        """
        path = path.resolve()
        if path not in self._files:
            used = {*_STUDY_FILES, *(file.name for file in self._files.values())}
            name = f"{path.name}{suffix}"
            if name in used:
                name = f"{path.parent.name}-{name}"
            self._files[path] = InputFile(unique_name(Path(name), used), content(path))
        return self._files[path]

    def _carried(
        self, choice: ForecastChoice, site: Site
    ) -> tuple[ForecastChoice, dict[str, InputFile]]:
        """Return a choice of forecasts with the names of its files in the study, and the files.

        A directory becomes one file in the project's own format.
        """
        skill, path = choice.skill_file, choice.file
        files = {} if skill is None else {"skill": self._input(skill)}
        if path is not None and path.is_dir():
            archive = read_archive(path, site, choice.delay)
            if all(issue.available is None for issue in archive.issues):
                choice = replace(choice, delay=archive.delay)
            files["file"] = self._input(
                path, lambda _: write_forecasts(archive.issues).encode(), ".csv"
            )
        elif path is not None:
            files["file"] = self._input(path)
        return in_directory(choice, files, Path()), files

    def _initial_states(
        self, site_file: Path, site: Site
    ) -> Iterator[tuple[str, tuple[float, float]]]:
        """Yield the name and volumes (m3) of each initial state."""
        named = {name: initial_state(site, name) for name in INITIAL_STATES}
        own, names = site_state(site), set()
        if own is not None:
            named[SITE_STATE] = own
        for state in self._blocks(self._mapping, "initial", _STATE):
            if "initial" not in state:
                volumes = self._volumes(state, {"cistern": site.a1, "roof": site.a2})
            elif state["initial"] in named:
                volumes = named[state["initial"]]
            else:
                wrong = f"{state['initial']!r} {_STATE}"
                if state["initial"] == SITE_STATE:
                    needed = " and ".join(SITE_STATE_KEYS)
                    wrong = f"{SITE_STATE} needs {needed} in {site_file.name}"
                raise self._refuse(self._mapping, "initial", wrong)
            name = state.get("initial") or self._text(state, "name")
            if name in names:
                raise self._refuse(self._mapping, "initial", f"has {name} twice")
            names.add(name)
            with self._at(self._mapping, "initial"):
                check_volumes(site, *volumes, keys=("cistern", "roof"))
            yield name, volumes

    def _volumes(self, state: YamlMapping, areas: dict[str, float]) -> tuple[float, float]:
        """Return the volumes (m3) of a state that gives volumes, or levels over the given areas."""
        self._keys(state, {"name": _NAME}, (*areas, *(f"{key}_level" for key in areas)))
        volumes = []
        for key, area in areas.items():
            given = [name for name in (key, f"{key}_level") if name in state]
            if len(given) != 1:
                raise self._refuse(
                    self._mapping, "initial", f"a state must give either {key} or {key}_level"
                )
            volume = self._number(state, given[0], Range(0.0))
            volumes.append(volume * (1.0 if key in state else area))
        return volumes[0], volumes[1]

    def _bound_block(self, site: Site) -> float | None:
        """Return ``bound_block:`` (s), whole ticks of a site or 0; None if there is no such key."""
        if "bound_block" not in self._mapping:
            return None
        seconds = self._number(self._mapping, "bound_block")
        if seconds:
            with self._at(self._mapping, "bound_block"):
                count_ticks(site, seconds, "bound_block", unit_s=1.0)
        return seconds

    def _controllers(self, sites: Collection[str]) -> Iterator[_Setting]:
        """Yield each controller with each combination of its parameters.

        Args:
            sites: names of the grid's site files.
        """
        section = self._mapping["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(self._mapping, "controllers", _CONTROLLERS)
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
            if section[reference] is None:
                yield _Setting(controller, {}, None, [])
                continue
            for given in self._blocks(section, reference, _SETTINGS):
                yield from self._settings(controller, given, sites)

    def _settings(
        self, controller: ControllerChoice, given: YamlMapping, sites: Collection[str]
    ) -> Iterator[_Setting]:
        """Yield a controller with each combination of the given parameters."""
        forecasts = list(self._forecasts(given)) if "forecast" in given else None
        own = []
        if "site" in given:
            own = [self._text(named, "site") for named in self._combinations(given, ["site"])]
        for name in own:
            if name not in sites:
                raise self._refuse(
                    given, "site",
                    f"{name} is not under 'site:' of the grid, which has {', '.join(sites)}",
                )
        names = [key for key in given if key not in ("forecast", "site")]
        for name in names:
            controller.check_name(name, self._path, given.lines[name])
        for values in self._combinations(given, names):
            parameters = read_numbers(self._path, values, controller.parameters)
            yield _Setting(controller, parameters, forecasts, own)

    @contextmanager
    def _at(self, mapping: YamlMapping, key: str, prefix: str = "") -> Iterator[None]:
        """Add the line of the grid to an error that is found elsewhere."""
        try:
            yield
        except ConfigurationError as error:
            line = mapping.lines.get(key, min(mapping.lines.values()))
            what = f"{prefix}{error.wrong}" if prefix else str(error)
            raise ConfigurationError(what, file=self._path, line=line) from error

    def _blocks(self, mapping: YamlMapping, key: str, expected: str) -> list[YamlMapping]:
        """Return the value of a key as a list of mappings; a text becomes ``{key: text}``."""
        blocks = []
        for block in self._listed(mapping, key):
            if isinstance(block, str):
                block = YamlMapping({key: block})
                block.lines = {key: mapping.lines[key]}
            if not isinstance(block, YamlMapping):
                raise self._refuse(mapping, key, expected)
            blocks.append(block)
        return blocks

    def _combinations(self, block: YamlMapping, names: Iterable[str]) -> Iterator[YamlMapping]:
        lists = {name: self._listed(block, name) for name in names if name in block}
        for values in itertools.product(*lists.values()):
            chosen = YamlMapping({**block, **dict(zip(lists, values, strict=True))})
            chosen.lines = block.lines
            yield chosen

    def _listed(self, mapping: YamlMapping, key: str) -> list[Any]:
        """Return a value as a list; a single value becomes a list of one.

        Whole numbers may be given as ``{from: 1, to: 50}``.
        """
        value = mapping[key]
        values = value if isinstance(value, list) else [value]
        if isinstance(value, YamlMapping) and value.keys() & {"from", "to"}:
            if value.keys() != {"from", "to"} or {*map(type, value.values())} != {int}:
                raise self._refuse(mapping, key, "must be {from: 1, to: 50} or the like")
            values = list(range(value["from"], value["to"] + 1))
        if not values:
            raise self._refuse(mapping, key, "is empty")
        return values

    def _number(self, mapping: YamlMapping, key: str, allowed: Range = _ANY) -> float:
        return allowed.read(mapping[key], file=self._path, line=mapping.lines[key], key=key)

    def _text(self, mapping: YamlMapping, key: str) -> str:
        if not isinstance(mapping[key], str):
            raise self._refuse(mapping, key, _TEXTS.get(key, "must be text"))
        return str(mapping[key])

    def _keys(
        self, mapping: YamlMapping, needed: Mapping[str, str], further: Collection[str]
    ) -> None:
        """Refuse a mapping that lacks a needed key or has an unknown one.

        Args:
            mapping: of the grid.
            needed: what the value of each needed key must be.
            further: other keys.
        """
        known = dict.fromkeys((*needed, *further))
        for key in mapping:
            if key not in known:
                raise self._refuse(
                    mapping, key, f"is not a key here; {suggest_names(key, known)}"
                )
        for key, expected in needed.items():
            if mapping.get(key) in (None, [], {}, ""):
                raise ConfigurationError(
                    f"is missing or empty; it {expected}", file=self._path,
                    line=min(mapping.lines.values(), default=None), key=key,
                )

    def _refuse(self, mapping: YamlMapping, key: str, expected: str) -> ConfigurationError:
        return ConfigurationError(
            expected, file=self._path, line=mapping.lines[key], key=key,
            value=None if isinstance(mapping[key], (dict, list)) else mapping[key],
        )
