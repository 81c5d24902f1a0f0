"""The grid of a study: a YAML file with lists of values, every combination of which is a run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.analysis.case import Case
from greenroof_ros.analysis.study import Files
from greenroof_ros.analysis.tables import check_metrics, choose_metrics
from greenroof_ros.base.errors import ConfigurationError, suggest_names
from greenroof_ros.base.files import YamlMapping, find_named, read_yaml
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.registry import ControllerChoice, find_controller
from greenroof_ros.forecast.choice import MODELS
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.site.file import read_site
from greenroof_ros.site.site import Site

_NEEDED = "site", "weather", "initial", "controllers"
_KEYS = *_NEEDED, "forecast", "show"
# Keys whose lists do not multiply the number of runs, because they belong together or name blocks.
_WHOLE = "file", "forecast"
# Any year followed by another that is not a leap year, as this one.
_USUAL_YEAR = 2001


class Grid(NamedTuple):
    """The content of a grid file."""

    cases: list[Case]
    """different runs, in the order of the file: sites, windows, initial states, controllers with
    their parameters, forecasts"""
    files: Files
    show: list[str]
    """metrics that the study is about"""


def read_grid(path: Path) -> Grid:
    """Read a grid such as ``config/studies/paper.yaml``, and check every run in it.

    Args:
        path: path of the grid. The files that it names are next to it, or in the package.

    Raises:
        ConfigurationError: if the grid, or a file that it names, is invalid; this is checked before
            the first run.
    """
    reader = _Reader(path)
    show = reader.list_shown()
    cases = [*{case.identity: case for case in reader.cases()}.values()]
    reader.files.contents["grid.yaml"] = path.read_bytes()
    return Grid(cases, reader.files, show or choose_metrics(case.site for case in cases))


def _end_on_same_day(start: str, hours: float) -> float:
    """Return the length (h) of a season that ends on the same day, leap year or not."""
    begins = datetime.fromisoformat(start)
    usual = begins.replace(year=_USUAL_YEAR)
    end = usual + timedelta(hours=hours)
    end = end.replace(year=end.year - usual.year + begins.year)
    return (end - begins) / timedelta(hours=1)


class _Reader:
    """A grid file while it is being read.

    Every block is a mapping or a list of mappings, and every list in a mapping multiplies the
    number of runs.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._content, self.files = path, read_yaml(path), Files()
        for key in self._content:
            if key not in _KEYS:
                hint = suggest_names(key, _KEYS)
                raise self._refuse(self._content, key, f"is not a valid key; {hint}")
        for key in _NEEDED:
            if self._content.get(key) in (None, [], {}, ""):
                raise ConfigurationError("is missing or empty", file=path, key=key)

    def list_shown(self) -> list[str]:
        """Return the metrics under ``show:``, if any."""
        names = self._list(self._content, "show") if "show" in self._content else []
        with self._at(self._content.lines, "show"):
            check_metrics(names)
        return names

    def cases(self) -> Iterator[Case]:
        windows = [*self._windows()]
        usual = [*self._forecasts(self._content)] or [YamlMapping()]
        settings = [*self._settings(usual)]
        for site, name in self._sites():
            for window, state, (controller, parameters, forecast) in itertools.product(
                windows, self._states(site), settings
            ):
                parts = window, forecast, state, parameters
                given = {key: value for part in parts for key, value in part.items()}
                lines = {**self._content.lines}
                lines |= {key: line for part in parts for key, line in part.lines.items()}
                with self._at(lines, "start"):
                    inputs = replace(make_inputs(controller, given), site=site)
                    yield self.files.make_case(inputs, name)

    def _sites(self) -> Iterator[tuple[Site, str]]:
        """Yield every site, with the name of its file."""
        for block in self._expand(self._content, "site", "file"):
            own = {name: value for name, value in block.items() if name != "file"}
            for file in self._find(block, "file", block["file"]):
                with self._at(block.lines, "file"):
                    yield read_site(file, own), file.name

    def _windows(self) -> Iterator[YamlMapping]:
        """Yield the inputs of every window."""
        for block in self._expand(self._content, "weather", "file"):
            year = str(block.pop("year", "{year}"))
            names = self._list(block, "file")
            block["weather"] = [file for name in names for file in self._find(block, "file", name)]
            del block["file"]
            block["start"] = str(block.get("start", "")).replace("{year}", year)
            with suppress(ValueError, KeyError, TypeError):  # what is wrong is found later
                if year.isdecimal():
                    block["hours"] = _end_on_same_day(block["start"], block["hours"])
            line = block.lines["file"]
            yield YamlMapping(block, {"start": line, **block.lines, "weather": line})

    def _forecasts(self, mapping: YamlMapping) -> Iterator[YamlMapping]:
        """Yield every forecast under ``forecast:`` with every combination of its options."""
        for block in self._expand(mapping, "forecast", "model") if "forecast" in mapping else ():
            model = str(block["model"])
            if model not in MODELS:
                block["model"] = str(self._find(block, "model", model)[0])
            names = {key: f"forecast_{key}".removesuffix("_model") for key in block}
            given, lines = (
                {names[key]: each[key] for key in block} for each in (block, block.lines)
            )
            yield YamlMapping(given, lines)

    def _states(self, site: Site) -> Iterator[YamlMapping]:
        """Yield the inputs of every initial state, from its name, volumes (m3) or levels (m)."""
        for block in self._expand(self._content, "initial", "name"):
            lines = block.lines | {"initial": block.lines["name"]}
            given = {"initial": block.pop("name"), **block}
            for key, area in (("cistern", site.a1), ("roof", site.a2)):
                if (name := f"{key}_level") in block:
                    line = lines[key] = lines[name]
                    level = Range().read(given.pop(name), file=self._path, line=line, key=name)
                    given[key] = area * level
            yield YamlMapping(given, lines)

    def _settings(
        self, usual: Sequence[YamlMapping]
    ) -> Iterator[tuple[ControllerChoice, YamlMapping, YamlMapping]]:
        """Yield every controller, every combination of its parameters, and every forecast.

        Without forecasts of its own, a controller receives the usual ones.
        """
        section = self._content["controllers"]
        if not isinstance(section, YamlMapping):
            raise self._refuse(
                self._content, "controllers", "must contain controllers, each with its parameters"
            )
        for reference in section:
            with self._at(section.lines, reference):
                controller = find_controller(reference)
            for block in self._expand(section, reference):
                forecasts = [*self._forecasts(block)] or usual
                block.pop("forecast", None)
                yield from ((controller, block, forecast) for forecast in forecasts)

    def _find(self, mapping: YamlMapping, key: str, name: str) -> list[Path]:
        """Return the files that match a name or pattern in a mapping."""
        with self._at(mapping.lines, key):
            return find_named(name, self._path, key)

    def _expand(self, mapping: YamlMapping, key: str, first: str = "") -> Iterator[YamlMapping]:
        """Yield every combination of the values in every block under a key.

        Args:
            mapping: mapping that contains the key.
            key: key of a block or of a list of blocks.
            first: key that a block must contain; a text stands for a block with only this key.
        """
        for block in self._list(mapping, key):
            if block is None:  # a controller without parameters
                block = YamlMapping()
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

    def _refuse(self, mapping: YamlMapping, key: str, expected: str) -> ConfigurationError:
        return ConfigurationError(
            expected, file=self._path, line=mapping.lines[key], key=key,
            value=None if isinstance(mapping[key], (dict, list)) else mapping[key],
        )

    @contextmanager
    def _at(self, lines: Mapping[str, int], otherwise: str) -> Iterator[None]:
        """Add the line number in the grid to an error that is raised elsewhere.

        Args:
            lines: lines of the inputs, by their names in errors.
            otherwise: input whose line is used if the error does not name an input.
        """
        try:
            yield
        except ConfigurationError as error:
            line = lines.get(error.key or "", lines[otherwise])
            raise ConfigurationError(str(error), file=self._path, line=line) from error
