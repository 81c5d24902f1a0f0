"""The grid of a study: a YAML file with lists of values, every combination of which is a run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.analysis.case import Case
from greenroof_ros.analysis.names import leap_hours
from greenroof_ros.analysis.study import Files
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import YamlMapping, find_matches, read_yaml, shared_directory
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.forecast.choice import MODELS, PERFECT
from greenroof_ros.results.metrics import METRICS
from greenroof_ros.simulation.bound import BLOCK_S
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

_NEEDED = "site", "weather", "initial", "controllers"
_USUAL: dict[str, Any] = {
    "forecast": PERFECT, "sensor_and_pump": YamlMapping(), "show": [],
}
# Keys whose lists do not multiply the number of runs, because they belong together or name blocks.
_WHOLE = "file", "forecast"


class Grid(NamedTuple):
    """The content of a grid file."""

    cases: list[Case]
    """different runs, in the order of the file: sites, windows, initial states, sensor_and_pump,
    controllers with their parameters, forecasts"""
    files: Files
    show: list[str]
    """metrics that the study asks for"""


def read_grid(path: Path) -> Grid:
    """Read a grid such as ``config/studies/paper.yaml``, and check every run in it.

    Args:
        path: path of the grid. The files that it names are next to it, or in the package.

    Raises:
        ConfigurationError: if the grid, or a file that it names, is invalid; this is checked before
            the first run.
    """
    reader = _Reader(path)
    cases = [*{case.identity: case for case in reader.cases()}.values()]
    reader.files.contents["grid.yaml"] = path.read_bytes()
    return Grid(cases, reader.files, reader.shown())


class _Reader:
    """A grid file while it is being read.

    Every block is a mapping or a list of mappings, and every list in a mapping multiplies the
    number of runs.
    """

    def __init__(self, path: Path) -> None:
        config = shared_directory() / "config"
        # This order makes a copy of one of the package's grids run unchanged.
        self._places = [path.parent, config, config / "weather"]
        self._path, content, self.files = path, read_yaml(path), Files()
        known = *_NEEDED, *_USUAL, "bound_block"
        for key in content:
            if key not in known:
                hint = suggest_names(key, known)
                raise self._refuse(content, key, f"is not a valid key; {hint}")
        for key in _NEEDED:
            if content.get(key) in (None, [], {}, ""):
                raise ConfigurationError("is missing or empty", file=path, key=key)
        self._content = YamlMapping(
            {**_USUAL, **content}, {**dict.fromkeys(_USUAL, 1), **content.lines}
        )

    def shown(self) -> list[str]:
        """Return the metrics under ``show:``."""
        known, names = [metric.name for metric in METRICS], self._list(self._content, "show")
        for name in names:
            if name not in known:
                hint = suggest_names(str(name), known)
                raise self._refuse(self._content, "show", f"{name} is no metric; {hint}")
        return names

    def cases(self) -> Iterator[Case]:
        sensors, settings = [*self._expand("sensor_and_pump")], [*self._settings()]
        for site, name in self._sites():
            states, block = [*self._states(site)], site.tau * max(1, round(BLOCK_S / site.tau))
            if "bound_block" in self._content:
                block = self._number(self._content, "bound_block")
            for window, usual in self._windows():
                for state, errors, setting in itertools.product(states, sensors, settings):
                    controller, parameters, forecasts = setting
                    for forecast in forecasts or usual:
                        parts = window, forecast, state, errors, parameters
                        given = {key: value for part in parts for key, value in part.items()}
                        lines = {**self._content.lines}
                        lines |= {key: line for each in parts for key, line in each.lines.items()}
                        with self._at(lines, "start"):
                            inputs = replace(make_inputs(controller, given), site=site)
                            yield self.files.make_case(inputs, name, block)

    def _sites(self) -> Iterator[tuple[Site, str]]:
        """Yield every site, with the name of its file."""
        for block in self._expand("site", "file"):
            own = {name: value for name, value in block.items() if name != "file"}
            for file in self._find(block, "file"):
                with self._at(block.lines, "file", f"{file.name} with these values: " * bool(own)):
                    yield read_site(file, own), file.name

    def _windows(self) -> Iterator[tuple[YamlMapping, list[YamlMapping]]]:
        """Yield the inputs and the forecasts of every window."""
        for block in self._expand("weather", "file"):
            year, forecasts = str(block.pop("year", "{year}")), self._content
            if "forecast" in block:
                forecasts = block
            given = {key: block[key] for key in block if key not in _WHOLE}
            given["start"] = str(block.get("start", "")).replace("{year}", year)
            given["weather"] = [
                file for name in self._list(block, "file")
                for file in self._find(block, "file", str(name).replace("{year}", year))
            ]
            with suppress(ValueError, KeyError, TypeError):
                if year.isdecimal():
                    start = datetime.fromisoformat(given["start"])
                    given["hours"] += leap_hours(start, given["hours"])
            lines = {**block.lines, "weather": block.lines["file"]}
            lines.setdefault("start", lines["file"])
            yield YamlMapping(given, lines), [*self._forecasts(forecasts)]

    def _forecasts(self, mapping: YamlMapping) -> Iterator[YamlMapping]:
        """Yield every forecast under ``forecast:`` with every combination of its options."""
        for block in self._expand("forecast", "model", mapping):
            model = str(block["model"])
            is_directory = any((place / model).is_dir() for place in self._places)
            if model not in MODELS and (Path(model).suffix or is_directory):
                block["model"] = str(self._find(block, "model")[0])
            names = {key: f"forecast_{key}" if key != "model" else "forecast" for key in block}
            yield YamlMapping(
                {name: block[key] for key, name in names.items()},
                {name: block.lines[key] for key, name in names.items()},
            )

    def _states(self, site: Site) -> Iterator[YamlMapping]:
        """Yield the inputs of every initial state, from its name, volumes (m3) or levels (m)."""
        for block in self._expand("initial", "name"):
            lines = block.lines | {"initial": block.lines["name"]}
            given = {"initial": block.pop("name"), **block}
            for key, area in (("cistern", site.a1), ("roof", site.a2)):
                if (level := f"{key}_level") in block:
                    given[key], lines[key] = area * self._number(block, level), lines[level]
                    del given[level]
            yield YamlMapping(given, lines)

    def _settings(self) -> Iterator[tuple[ControllerChoice, YamlMapping, list[YamlMapping]]]:
        """Yield every controller, every combination of its parameters, and its own forecasts.

        Without forecasts of its own, it receives those of the grid.
        """
        section = self._content["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(
                self._content, "controllers", "must contain controllers, each with its parameters"
            )
        for reference in section:
            with self._at(section.lines, reference):
                controller = find_controller(reference)
            blocks = [YamlMapping()]
            if section[reference] is not None:
                blocks = [*self._expand(reference, mapping=section)]
            for block in blocks:
                forecasts = [*self._forecasts(block)] if "forecast" in block else []
                block.pop("forecast", None)
                yield controller, block, forecasts

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
        places = ", ".join(str(place.resolve()) for place in self._places)
        raise self._refuse(mapping, key, f"there is no {name} in {places}")

    def _expand(
        self, key: str, first: str = "", mapping: YamlMapping | None = None
    ) -> Iterator[YamlMapping]:
        """Yield every combination of the values in every block under a key.

        Args:
            key: key of a block or of a list of blocks.
            first: key that a block must contain; a text stands for a block with only this key.
            mapping: mapping that contains the key; None for the grid.
        """
        mapping = self._content if mapping is None else mapping
        for block in self._list(mapping, key):
            if isinstance(block, str) and first:
                block = YamlMapping({first: block}, {first: mapping.lines[key]})
            if not isinstance(block, YamlMapping) or (first and first not in block):
                what = f"a mapping with the key {first}" if first else "a mapping"
                raise self._refuse(mapping, key, f"must be {what}, or a list of these")
            lists = [[block[name]] if name in _WHOLE else self._list(block, name) for name in block]
            for values in itertools.product(*lists):
                yield YamlMapping(dict(zip(block, values, strict=True)), block.lines)

    def _list(self, mapping: YamlMapping, key: str) -> list[Any]:
        """Return a value as a list; a single value becomes a list with one item.

        A range of whole numbers may be written as ``{from: 1, to: 50}``.
        """
        value = mapping[key]
        if isinstance(value, YamlMapping) and value.keys() & {"from", "to"}:
            if value.keys() != {"from", "to"} or {*map(type, value.values())} != {int}:
                raise self._refuse(
                    mapping, key, "must be a range of whole numbers, such as {from: 1, to: 50}"
                )
            return [*range(value["from"], value["to"] + 1)]
        return value if isinstance(value, list) else [value]

    def _number(self, mapping: YamlMapping, key: str) -> float:
        return Range().read(mapping[key], file=self._path, line=mapping.lines[key], key=key)

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
