"""The grid of a study: a YAML file with lists of values, every combination of which is a run."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.analysis.study.case import Case, InputFile
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import (
    YamlMapping,
    find_matches,
    read_yaml,
    shared_directory,
    unique_name,
)
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.outlet import find_horizon
from greenroof_ros.controllers.registry import BUILT_IN, ControllerChoice, find_controller
from greenroof_ros.forecast.choice import MODELS, OPTIONS, PERFECT, ForecastChoice
from greenroof_ros.forecast.issue import read_archive, write_forecasts
from greenroof_ros.physics.sensor_and_pump import PARAMETERS, SensorAndPump
from greenroof_ros.physics.start import INITIAL_STATES
from greenroof_ros.results.table import format_exactly
from greenroof_ros.simulation.bound import BLOCK_S
from greenroof_ros.simulation.inputs import RunInputs, make_inputs
from greenroof_ros.simulation.run import Run, count_ticks
from greenroof_ros.site.file import SITE_KEYS, format_site, read_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import read_weather, write_plain
from greenroof_ros.weather.records import name_files

# What each block must be.
_BLOCKS = {
    "site": "the name of a file, {file: site.yaml, tau: 10.0, a1: [10.0, 25.0]}, or a list of "
    "these",
    "weather": "a list of windows, each with 'file:', 'start:' and 'hours:'",
    "initial": f"one of {', '.join(INITIAL_STATES)}, {{name: dry, cistern: 60.0, roof: 1.0}} in "
    "m3, or a list of these",
    "controllers": "controllers, each with its parameters: "
    f"{', '.join(BUILT_IN)}, or package.module:Class",
    "forecast": f"one of {', '.join(MODELS)}, a file or directory of forecasts, "
    "{model: errors, skill: real, seed: [1, 2]}, or a list of these",
    "sensor_and_pump": "a mapping such as {roof_noise: 0.0005, roof_offset: [0, 0.002]}, "
    "or a list of these",
}
_NEEDED = ("site", "weather", "initial", "controllers")
# The inputs that a window sets, in addition to its files.
_OF_WINDOW = ("start", "hours", "evapotranspiration", "gaps")
# Names that the directory of a study uses itself.
_STUDY_FILES = ("grid.yaml", "study.json")


class _Setting(NamedTuple):
    """A controller with its parameters, and the forecasts that it receives."""

    controller: ControllerChoice
    parameters: YamlMapping
    forecasts: list[YamlMapping]
    """forecasts instead of the grid's, for instance if it uses none; empty for the grid's"""


def read_grid(
    path: Path, weather: Path | None = None,
    show: Callable[[Mapping[str, Any], str], None] = lambda summary, name: None,
) -> list[Case]:
    """Read a grid such as ``config/studies/paper.yaml``, and check every run in it.

    Args:
        path: path of the grid.
        weather: directory to search for weather files that are not next to the grid.
        show: function that receives the summary of every weather record, and the record's name.

    Returns:
        The runs, in the order of the file: sites, windows, methods, initial states,
        sensor_and_pump, controllers with their parameters, forecasts.

    Raises:
        ConfigurationError: if the grid, or a file that it names, is invalid; this is checked before
            the first run.
    """
    cases = list(_Grid(path, weather, show).cases())
    identities: set[str] = set()
    for case in cases:
        if case.identity in identities:
            inputs = case.inputs
            raise ConfigurationError(
                f"contains the same run twice: {inputs.controller.name} {inputs.parameters}, "
                f"{inputs.initial}, from {inputs.start}, forecast {inputs.forecast}, "
                f"{inputs.sensor_and_pump.values()}", file=path,
            )
        identities.add(case.identity)
    return cases


class _Grid:
    """A grid file while it is being read.

    Every block is a mapping or a list of mappings, and every list in a mapping multiplies the
    number of runs.
    """

    def __init__(
        self, path: Path, weather: Path | None, show: Callable[[Mapping[str, Any], str], None]
    ) -> None:
        self._path, self._show = path, show
        self._shown = set[str]()
        # This order makes a copy of one of the package's grids run unchanged.
        self._places = [
            path.parent, *([] if weather is None else [weather]), shared_directory() / "config",
        ]
        content, usual = read_yaml(path), {"forecast": PERFECT, "sensor_and_pump": YamlMapping()}
        self._check_keys(content, _NEEDED, (*usual, "bound_block"))
        self._mapping = YamlMapping(
            {**usual, **content}, {**dict.fromkeys(usual, 1), **content.lines}
        )
        self._files: dict[tuple[Path, bytes], InputFile] = {}
        self._weathers: dict[tuple[InputFile, ...], str] = {}
        # Every file is read once for all runs that use it in the same way.
        self._read_bytes = functools.cache(Path.read_bytes)
        self._read_weather = functools.cache(read_weather)
        self._write_plain = functools.cache(write_plain)
        self._carry = functools.cache(self._carry_forecast)

    def cases(self) -> Iterator[Case]:
        sensors_and_pumps = list(self._expand(self._mapping, "sensor_and_pump", (), PARAMETERS))
        further = sensors_and_pumps, list(self._expand_controllers())
        for site, file in self._expand_sites():
            states = list(self._expand_states(site))
            for window, usual in self._expand_windows():
                runs: dict[tuple[object, ...], Run] = {}
                for state, sensor_and_pump, setting in itertools.product(states, *further):
                    for forecast in setting.forecasts or usual:
                        given, lines = dict[str, Any](), dict[str, int]()
                        for part in (window, forecast, state, sensor_and_pump, setting.parameters):
                            given |= part
                            lines |= part.lines
                        with self._at(lines, "start"):
                            inputs = replace(make_inputs(setting.controller, given), site=site)
                            case = self._complete(inputs, site, file, runs)
                        yield case

    def _complete(
        self, inputs: RunInputs, site: Site, file: InputFile, runs: dict[tuple[object, ...], Run]
    ) -> Case:
        """Check a run, and return its case.

        Raises:
            ConfigurationError: if the run is invalid.
        """
        parameters = inputs.controller.complete_parameters(site, inputs.parameters)
        # Runs that need the same records are built once; forecasts with errors need the same
        # records as perfect forecasts.
        seeded = "seed" in inputs.forecast.options()
        alike = replace(inputs, forecast=ForecastChoice()) if seeded else inputs
        others = replace(
            alike, controller=find_controller("onoff"), parameters={},
            sensor_and_pump=SensorAndPump(),
        )
        horizons = parameters.get("horizon"), find_horizon(parameters)
        key = horizons, inputs.controller.ensemble, repr(others)
        if key not in runs:
            weather = self._read_weather(
                alike.weather, site.place, alike.evapotranspiration, alike.gaps
            )
            runs[key] = replace(alike, weather=weather).build()
            self._show_weather(runs[key])
        run = runs[key]
        plain = self._write_plain(alike.weather, site.place)
        if plain is None:
            files = tuple(map(self._input, run.weather.files))
        else:
            files = (self._input(Path(f"{run.weather.files[0].stem}.csv"), plain.encode()),)
        name = name_files([Path(each.name) for each in files])
        forecast, forecast_file = self._carry(inputs.forecast, site)
        return Case(
            replace(
                inputs, site=Path(file.name), weather=tuple(Path(each.name) for each in files),
                parameters=parameters, forecast=forecast, start=run.start.isoformat(),
                hours=run.steps * site.tau / 3600, evapotranspiration=run.weather.method,
                initial=run.initial, cistern=run.x1, roof=run.x2,
            ),
            file, files,
            self._weathers.setdefault(files, unique_name(Path(name), self._weathers.values())),
            forecast_file, self._bound_block(site), run.steps,
        )

    def _expand_sites(self) -> Iterator[tuple[Site, InputFile]]:
        for values in self._expand(self._mapping, "site", ("file",), SITE_KEYS):
            own = {name: value for name, value in values.items() if name != "file"}
            for file in self._find(values, "file"):
                site, path = read_site(file), file
                if own:
                    with self._at(values.lines, "file", f"{file.name} with these values: "):
                        site = read_site(file, own)
                    label = "_".join(
                        f"{name}-{_label(value)}" for name, value in own.items()
                    )
                    path = file.with_name(f"{file.stem}_{label.replace('/', '-')}.yaml")
                yield site, self._input(path, format_site(site).encode())

    def _expand_windows(self) -> Iterator[tuple[YamlMapping, list[YamlMapping]]]:
        """Yield the inputs and the forecasts of every window."""
        for window in self._expand(
            self._mapping, "weather", ("file", "start"), (*_OF_WINDOW, "year", "forecast"),
            whole=("file", "forecast"),
        ):
            year = str(window.get("year", "{year}"))
            given = {name: window[name] for name in _OF_WINDOW if name in window}
            given["start"] = str(window["start"]).replace("{year}", year)
            given["weather"] = [
                file for name in self._list(window, "file")
                for file in self._find(window, "file", str(name).replace("{year}", year))
            ]
            lines = {**window.lines, "weather": window.lines["file"]}
            forecasts = window if "forecast" in window else self._mapping
            yield YamlMapping(given, lines), list(self._expand_forecasts(forecasts))

    def _expand_forecasts(self, mapping: YamlMapping) -> Iterator[YamlMapping]:
        """Yield every forecast under ``forecast:`` with every combination of its options."""
        for block in self._expand(mapping, "forecast", ("model",), OPTIONS):
            model = str(block["model"])
            is_directory = any((place / model).is_dir() for place in self._places)
            if model not in MODELS and (Path(model).suffix or is_directory):
                model = str(self._find(block, "model")[0])
            given = {f"forecast_{name}": block[name] for name in OPTIONS if name in block}
            lines = {f"forecast_{name}": line for name, line in block.lines.items()}
            lines["forecast"] = block.lines["model"]
            yield YamlMapping({"forecast": model, **given}, lines)

    def _expand_states(self, site: Site) -> Iterator[YamlMapping]:
        """Yield the inputs of every initial state, from its name, volumes (m3) or levels (m)."""
        areas, names = {"cistern": site.a1, "roof": site.a2}, set()
        levels = {f"{key}_level": key for key in areas}
        for state in self._expand(self._mapping, "initial", ("name",), (*areas, *levels)):
            given = {"initial": state["name"], **{key: state[key] for key in areas if key in state}}
            for level, key in levels.items():
                if level in state:
                    if key in state:
                        raise self._refuse(state, level, f"cannot be combined with {key}")
                    given[key] = self._number(state, level) * areas[key]
            if state["name"] in names:
                raise self._refuse(state, "name", "appears twice")
            names.add(state["name"])
            lines = {**dict.fromkeys(("initial", *areas), state.lines["name"]), **state.lines}
            yield YamlMapping(given, lines | {
                key: state.lines[level] for level, key in levels.items() if level in state
            })

    def _expand_controllers(self) -> Iterator[_Setting]:
        """Yield every controller with every combination of its parameters."""
        section = self._mapping["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(
                self._mapping, "controllers", f"must contain {_BLOCKS['controllers']}"
            )
        references: dict[str, str] = {}
        for reference in section:
            with self._at(section.lines, reference):
                controller = find_controller(reference)
            if controller.name in references:
                raise self._refuse(
                    section, reference,
                    f"is named {controller.name}, like {references[controller.name]}; rename its "
                    "class",
                )
            references[controller.name] = reference
            if section[reference] is None:
                yield _Setting(controller, YamlMapping(), [])
                continue
            for block in self._expand(
                section, reference, (), (*controller.parameters, "forecast"), whole=("forecast",)
            ):
                forecasts = list(self._expand_forecasts(block)) if "forecast" in block else []
                parameters = {key: value for key, value in block.items() if key != "forecast"}
                yield _Setting(controller, YamlMapping(parameters, block.lines), forecasts)

    def _bound_block(self, site: Site) -> float:
        """Return ``bound_block:`` (s), in whole ticks of a site, or 0; the default is a minute."""
        if "bound_block" not in self._mapping:
            return BLOCK_S
        seconds = self._number(self._mapping, "bound_block")
        if seconds:
            with self._at(self._mapping.lines, "bound_block"):
                count_ticks(site, seconds, "bound_block", unit_s=1.0)
        return seconds

    # --- files ------------------------------------------------------------------------------

    def _find(self, mapping: YamlMapping, key: str, name: str | None = None) -> list[Path]:
        """Return the files that match a name or pattern, from the first directory with such files.

        Args:
            mapping: a mapping in the grid.
            key: key of the name.
            name: name that replaces the value of the key.

        Raises:
            ConfigurationError: if no directory contains a matching file.
        """
        name = str(mapping[key]) if name is None else name
        if found := find_matches(name, self._places):
            return found
        first, *further, last = self._places
        raise self._refuse(
            mapping, key, f"{name} does not exist" if Path(name).is_absolute() else
            f"{name} is neither next to the grid, in {first.resolve()}, nor "
            + "".join(f"in --weather {place}, nor " for place in further)
            + f"among the package's own files, in {last}",
        )

    def _show_weather(self, run: Run) -> None:
        """Show what the weather of a run contains, once for every period."""
        name = f"{Path(run.weather.source).name}, {run.steps * run.site.tau / 3600:g} h"
        if (period := f"{name} from {run.start}") not in self._shown:
            self._shown.add(period)
            self._show(run.series.summary, name)

    def _input(self, path: Path, content: bytes | None = None) -> InputFile:
        """Return a file's content under a name that is unique in the study.

        The name is the file's own name, preceded by the folder's name if another file has the same
        name.

        Args:
            path: path of the file.
            content: content that replaces the file's own.
        """
        path = path.resolve()
        key = path, self._read_bytes(path) if content is None else content
        if key not in self._files:
            used = {*_STUDY_FILES, *(file.name for file in self._files.values())}
            name = path.name if path.name not in used else f"{path.parent.name}-{path.name}"
            self._files[key] = InputFile(unique_name(Path(name), used), key[1])
        return self._files[key]

    def _carry_forecast(
        self, choice: ForecastChoice, site: Site
    ) -> tuple[ForecastChoice, InputFile | None]:
        """Return a forecast choice that uses the file name in the study, together with the file.

        A directory is converted to a single file in the project's own format.
        """
        path = choice.file
        if path is None:
            return choice, None
        if path.is_dir():
            text = write_forecasts(read_archive(path, site))
            file = self._input(path.with_name(f"{path.name}.csv"), text.encode())
        else:
            file = self._input(path)
        return replace(choice, file=Path(file.name)), file

    # --- mappings ---------------------------------------------------------------------------

    def _expand(
        self, mapping: YamlMapping, key: str, needed: Collection[str], further: Collection[str],
        whole: Collection[str] = (),
    ) -> Iterator[YamlMapping]:
        """Yield every combination of the values in every block under a key.

        Args:
            mapping: mapping that contains the key.
            key: key of a block or of a list of blocks; a string stands for a block that contains
                only the first required key.
            needed: keys that a block must contain.
            further: additional keys that a block may contain.
            whole: keys whose lists do not multiply the number of runs.
        """
        for block in self._list(mapping, key):
            if isinstance(block, str) and needed:
                name = next(iter(needed))
                block = YamlMapping({name: block}, {name: mapping.lines[key]})
            if not isinstance(block, YamlMapping):
                expected = _BLOCKS.get(key, "a mapping of parameters, a list of these, or nothing")
                raise self._refuse(mapping, key, f"must be {expected}")
            self._check_keys(block, needed, further)
            lists = [self._list(block, name) if name not in whole else [block[name]]
                     for name in block]
            for values in itertools.product(*lists):
                yield YamlMapping(dict(zip(block, values, strict=True)), block.lines)

    def _list(self, mapping: YamlMapping, key: str) -> list[Any]:
        """Return a value as a list; a single value becomes a list with one item.

        A range of whole numbers may be written as ``{from: 1, to: 50}``.
        """
        value = mapping[key]
        values = value if isinstance(value, list) else [value]
        if isinstance(value, YamlMapping) and value.keys() & {"from", "to"}:
            if value.keys() != {"from", "to"} or {*map(type, value.values())} != {int}:
                raise self._refuse(
                    mapping, key, "must be a range of whole numbers, such as {from: 1, to: 50}"
                )
            values = list(range(value["from"], value["to"] + 1))
        if not values:
            raise self._refuse(mapping, key, "is empty")
        return values

    def _number(self, mapping: YamlMapping, key: str) -> float:
        return Range().read(mapping[key], file=self._path, line=mapping.lines[key], key=key)

    def _check_keys(
        self, mapping: YamlMapping, needed: Collection[str], further: Collection[str]
    ) -> None:
        """Reject a mapping in which a required key is missing or a key is unknown.

        Raises:
            ConfigurationError: if a required key is missing or a key is unknown.
        """
        known = dict.fromkeys((*needed, *further))
        for key in mapping:
            if key not in known:
                raise self._refuse(mapping, key, f"is not a valid key; {suggest_names(key, known)}")
        for key in needed:
            if mapping.get(key) in (None, [], {}, ""):
                expected = f"; it must be {_BLOCKS[key]}" if key in _BLOCKS else ""
                raise ConfigurationError(
                    f"is missing or empty{expected}", file=self._path,
                    line=min(mapping.lines.values(), default=None), key=key,
                )

    def _refuse(self, mapping: YamlMapping, key: str, expected: str) -> ConfigurationError:
        return ConfigurationError(
            expected, file=self._path, line=mapping.lines[key], key=key,
            value=None if isinstance(mapping[key], (dict, list)) else mapping[key],
        )

    @contextmanager
    def _at(
        self, lines: Mapping[str, int], otherwise: str, prefix: str = ""
    ) -> Iterator[None]:
        """Add the line number in the grid to an error that is raised elsewhere.

        Args:
            lines: lines of the inputs, by their names in errors.
            otherwise: input whose line is used if the error does not name an input.
            prefix: beginning of the message.
        """
        try:
            yield
        except ConfigurationError as error:
            line = lines.get(error.key or "", lines[otherwise])
            what = f"{prefix}{error.wrong}" if prefix else str(error)
            raise ConfigurationError(what, file=self._path, line=line) from error


def _label(value: Any) -> str:
    """Return a site value, which is a list for quiet hours, as part of a file name."""
    if isinstance(value, list):
        return "+".join(map(_label, value))
    return value if isinstance(value, str) else format_exactly(value)
