"""A case: the complete inputs of a run with their files, how it is run, and its bounds.

Names of the cases of a study state only what differs, in the words of the keys.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from importlib.machinery import PathFinder
from importlib.metadata import packages_distributions
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any, NamedTuple

from greenroof_ros.analysis.tables import BOUNDS, MAINS, TOTAL, WET
from greenroof_ros.base.parameter import Parameter, parameters_of
from greenroof_ros.controllers.onoff import OnOff
from greenroof_ros.controllers.outlet import CLOSED, DRAIN, OPEN, PLAN, PRICE
from greenroof_ros.controllers.registry import BUILT_IN, ControllerChoice, find_controller
from greenroof_ros.forecast.choice import OPTIONS, ForecastChoice
from greenroof_ros.physics.compiled import can_compile
from greenroof_ros.physics.pump import PARAMETERS, SensorAndPump
from greenroof_ros.results.table import format_exactly, summary_columns
from greenroof_ros.simulation import bound
from greenroof_ros.simulation.inputs import RunInputs
from greenroof_ros.simulation.loop import simulate
from greenroof_ros.simulation.run import Run
from greenroof_ros.site.file import DETERMINES, SITE_KEYS, format_site
from greenroof_ros.site.site import Site
from greenroof_ros.weather.read import read_weather
from greenroof_ros.weather.records import name_files

# Cases with the same weather follow each other, so a process reads its files once.
_read_weather = functools.lru_cache(2)(read_weather)
_OF_PLAN = "outlet_price", "outlet_reach"
# The parameters of the valve that a policy does not use.
_UNUSED = {
    CLOSED: ("outlet_reserve", *_OF_PLAN), OPEN: ("outlet_reserve", *_OF_PLAN), DRAIN: _OF_PLAN,
}


@dataclass(frozen=True)
class Case:
    """A run of a study, with everything that affects its numbers.

    Attributes:
        inputs: complete inputs of the run, with the site itself and the names of the other files.
        site_file: name of the file from which the site was read.
        files: digests of the weather files and any forecast file, by names that are unique in the
            study.
    """

    inputs: RunInputs
    site_file: str
    files: Mapping[str, str]

    @property
    def site(self) -> Site:
        """The site."""
        assert isinstance(self.inputs.site, Site)
        return self.inputs.site

    @property
    def hours(self) -> float:
        """Length of the run (h)."""
        return self.inputs.hours or 0.0

    @property
    def is_compiled(self) -> bool:
        """Whether the run is compiled, as with on/off control and the policies of the valve."""
        return self.inputs.controller.kind is OnOff and can_compile()

    @functools.cached_property
    def identity(self) -> str:
        """Twelve hexadecimal digits that are always the same for equal cases, on any machine."""
        inputs = self.inputs
        content = [
            {each.name: getattr(inputs, each.name) for each in parameters_of(RunInputs)},
            inputs.sensor_and_pump.values(), format_site(self.site), self.files,
            inputs.forecast.model, inputs.forecast.options(), inputs.parameters,
            inputs.controller.reference, identify_code(inputs.controller),
        ]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]

    @functools.cached_property
    def plain(self) -> Case:
        """The same case with on/off control, no forecast, and an ideal sensor and pump."""
        files = {path.name: self.files[path.name] for path in self.inputs.weather}
        return replace(self, files=files, inputs=replace(
            self.inputs, controller=find_controller("onoff"), parameters={},
            forecast=ForecastChoice(), sensor_and_pump=SensorAndPump(),
        ))

    def columns(self) -> dict[str, Any]:
        """Return the columns of the table that describe the case, except names and parameters."""
        inputs = self.inputs
        return {
            "weather": name_files(inputs.weather), "start": inputs.start, "hours": self.hours,
            "evapotranspiration": inputs.evapotranspiration, "gaps": inputs.gaps,
            **asdict(inputs.climate),
            "forecast": str(inputs.forecast),
            **{f"forecast_{name}": inputs.forecast.options().get(name) for name in OPTIONS},
            "controller": inputs.controller.name, "initial": inputs.initial,
            "cistern_m3": inputs.cistern, "roof_m3": inputs.roof,
            **inputs.sensor_and_pump.values(),
        }

    def build(self, directory: Path) -> Run:
        """Build the run from the files in a directory."""
        inputs, forecast = self.inputs, self.inputs.forecast
        if forecast.file is not None:
            forecast = replace(forecast, file=directory / forecast.file)
        weather = _read_weather(
            tuple(directory / file for file in inputs.weather), self.site.place,
            inputs.evapotranspiration, inputs.gaps, inputs.climate,
        )
        return replace(inputs, weather=weather, forecast=forecast).build()


def choose_used(inputs: RunInputs, site: Site) -> RunInputs:
    """Complete the parameters, without those and without the forecasts that a run does not use."""
    parameters = inputs.controller.complete_parameters(site, inputs.parameters)
    outlet = parameters.get("outlet")
    foresees = inputs.controller.kind is not OnOff or outlet == PLAN
    unused = _UNUSED.get(str(outlet), ())
    return replace(
        inputs, forecast=inputs.forecast if foresees else ForecastChoice(),
        parameters={name: value for name, value in parameters.items() if name not in unused},
    )


class Outcome(NamedTuple):
    """The results of a run."""

    results: dict[str, Any]
    """columns of the table, which do not depend on the duration of the run"""
    trajectory: bytes | None
    """content of the file of the trajectory; None if it is not kept"""


def run_case(directory: Path, case: Case, trajectory_every: float | None) -> Outcome:
    """Run a case.

    Args:
        directory: directory with the case's input files.
        case: case to run.
        trajectory_every: time between the samples of the trajectory (s), rounded to at least one
            whole tick; None to keep only the results.

    Raises:
        ConfigurationError: if the case is invalid.
    """
    run = case.build(directory)
    every = 0 if trajectory_every is None else run.count_ticks_between(trajectory_every)
    results, trajectory = simulate(run, every=every)
    kept = None if trajectory is None else trajectory.to_parquet()
    return Outcome(summary_columns(results), kept)


def compute_bounds(directory: Path, case: Case, show: Sequence[str]) -> dict[str, float]:
    """Return the columns of the minimum possible values of a case's shown metrics.

    They are the same for all controllers. The deviation is that of commands up to 1, see
    :func:`greenroof_ros.simulation.bound.clairvoyant_bound`. The wet-weather discharge of a valve
    is that with on/off control's irrigation, at the point of the frontier at which mains water
    costs as much as ``plan`` assumes; the mains water is left out if the site has no mains top-up.

    Args:
        directory: directory with the case's input files.
        case: the case.
        show: names of metrics.
    """
    run, bounds = case.plain.build(directory), dict[str, float]()
    if TOTAL in show:
        bounds[BOUNDS[TOTAL]] = bound.clairvoyant_bound(run, bound.BLOCK_S)
    if WET in show and run.site.low_outlet_valve:
        _, trajectory = simulate(run, every=1)
        assert trajectory is not None
        (point,) = bound.bound_discharge(run, trajectory, [PRICE])
        bounds[BOUNDS[WET]] = point.wet_discharge_m3
        if run.site.mains_level is not None:
            bounds[BOUNDS[MAINS]] = point.mains_m3
    return bounds


class _Finder(ModuleFinder):
    """Finds the modules that a module imports, also in folders without ``__init__.py``."""

    def find_module(self, name: str, path: Any, parent: Any = None) -> Any:
        spec = None if name in self.excludes else PathFinder.find_spec(name, path)
        if spec is None or spec.origin is not None:
            return super().find_module(name, path, parent)
        return None, next(iter(spec.submodule_search_locations or ())), ("", "", -1)

    def load_module(self, fqname: str, fp: Any, pathname: str, file_info: Any) -> Any:
        if file_info[2] != -1:  # not a plain folder
            return super().load_module(fqname, fp, pathname, file_info)
        module: Any = self.add_module(fqname)
        module.__path__ = [pathname]
        return module


@functools.cache
def identify_code(controller: ControllerChoice) -> str:
    """Return twelve digits that identify the code of a user's controller; empty if built in.

    They change with the source of its module and of all the modules that it imports, except those
    of the standard library, of this package and of other installed packages. Data files that the
    code reads, and modules that it imports by a computed name, are not covered.
    """
    if controller.reference in BUILT_IN:
        return ""
    modules = {controller.path.partition(":")[0], controller.kind.__module__}
    installed = {*sys.stdlib_module_names, *packages_distributions(), "greenroof_ros"}
    own = {name.partition(".")[0] for name in modules}
    finder = _Finder(excludes=[*installed - own])
    for name in sorted(modules):
        with suppress(ImportError):  # the class of a script or a notebook
            finder.import_hook(name)
    digest = hashlib.sha256()
    for name, module in sorted(finder.modules.items()):
        file: str | None = getattr(module, "__file__", None)  # None: a plain folder
        if file is not None:
            digest.update(name.encode() + b"\0" + Path(file).read_bytes() + b"\0")
    return digest.hexdigest()[:12]


# The words for the valve's policy, and for the parameters of a site that a plain key sets alone.
_WORDS = {"outlet": "valve"} | {own: key for key, (own, *more) in DETERMINES.items() if not more}


def name_cases(cases: Sequence[Case]) -> list[dict[str, str]]:
    """Return the columns that name the runs of a study, and group them.

    Runs with the same ``window`` and initial state are compared. Among these, runs with the same
    ``case`` differ only in their seeds and, if ``season`` is not empty, in the year. ``site`` is
    the name of a file in the study.
    """
    sites = tell_apart([_describe_site(case) for case in cases])
    seasons, of_season = list[dict[str, str]](), dict[str, set[int]]()
    for case, site in zip(cases, sites, strict=True):
        start, hours = datetime.fromisoformat(case.inputs.start), case.hours
        seasons.append({
            "site": site, "weather": name_files(case.inputs.weather),
            "start": f"from {start:%d %B %H:%M}",
            "hours": f"to {start + timedelta(hours=hours):%d %B %H:%M}",
            "evapotranspiration": f"{case.inputs.evapotranspiration} evapotranspiration",
            "gaps": f"gaps {case.inputs.gaps}",
            "climate": str(case.inputs.climate) or "climate of the record",
        })
        of_season.setdefault(str(seasons[-1]), set()).add(start.year)
    facts = [
        season if len(of_season[str(season)]) > 1 else season | {
            "start": f"from {case.inputs.start}", "hours": f"{format_exactly(case.hours)} h",
        } for case, season in zip(cases, seasons, strict=True)
    ]
    windows = tell_apart(facts)
    settings = dict[int, str]()
    for window in {*windows}:
        places = [place for place, other in enumerate(windows) if other == window]
        names = tell_apart([_describe_setting(cases[place]) for place in places])
        settings |= zip(places, names, strict=True)
    return [
        {
            "window": windows[place] or f"{facts[place]['start']}, {facts[place]['hours']}",
            "case": settings[place] or case.inputs.controller.name,
            "season": facts[place]["start"] if facts[place] is seasons[place] else "",
            "site": re.sub(r"[^-+.\w]+", "_", sites[place] or Path(case.site_file).stem) + ".yaml",
        } for place, case in enumerate(cases)
    ]


def tell_apart(facts: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a name for each mapping: the fewest of its texts that tell it from the others.

    Earlier keys are preferred. Equal mappings have the same name, and a single one has none.
    """
    names, groups = [list[str]() for _ in facts], [list(range(len(facts)))]
    for key in dict.fromkeys(key for each in facts for key in each):
        finer: dict[tuple[int, str], list[int]] = {}
        for number, group in enumerate(groups):
            for index in group:
                finer.setdefault((number, facts[index].get(key, "")), []).append(index)
        for (number, text), members in finer.items():
            if len(members) < len(groups[number]) and text:
                for index in members:
                    names[index].append(text)
        groups = [*finer.values()]
    return [", ".join(name) for name in names]


def _describe_site(case: Case) -> dict[str, str]:
    volume = case.site.cistern_volume(case.site.z_o)
    return {
        "file": Path(case.site_file).stem, "cistern": f"cistern {format_exactly(volume)} m3",
        **_describe(asdict(case.site), SITE_KEYS),
    }


def _describe_setting(case: Case) -> dict[str, str]:
    """Return what differs between the runs of a window, without seeds and what has no effect."""
    inputs, forecast = case.inputs, case.inputs.forecast
    return {
        "controller": inputs.controller.name,
        **dict.fromkeys(inputs.controller.parameters, ""),  # in this order
        **_describe(inputs.parameters, inputs.controller.parameters),
        "forecast": f"forecast {forecast}", **_describe(forecast.options(), OPTIONS),
        **_describe(inputs.sensor_and_pump.values(), PARAMETERS),
    }


def _describe(values: Mapping[str, Any], known: Mapping[str, Parameter]) -> dict[str, str]:
    """Return the words, the value and the unit of each key, without seeds."""
    texts = {
        name: format_exactly(value) if isinstance(value, (int, float)) else str(value)
        for name, value in values.items() if value is not None and not name.endswith("seed")
    }
    return {
        name: " ".join(filter(None, [
            _WORDS.get(name, name).replace("_", " "), text,
            "" if (unit := known[name].unit) == "1" else unit,
        ])) for name, text in texts.items()
    }
