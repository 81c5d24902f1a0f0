"""Scenarios: fixed runs with a score, its lower bound, and the scores of reference controllers.

``config/scenarios.yaml`` defines the scenarios. ``config/scenarios.csv`` lists the scores of the
reference controllers, which ``tools/reference_scores.py`` computes with :func:`evaluate`.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from greenroof_ros.api.simulate import Function, Result, read_site, simulate
from greenroof_ros.base.errors import ConfigurationError, describe_choices
from greenroof_ros.base.files import read_lines, read_yaml, shared_directory
from greenroof_ros.controllers.protocol import Controller
from greenroof_ros.results.forked_polars import make_frame
from greenroof_ros.simulation.bound import BLOCK_S, bound_discharge, clairvoyant_bound
from greenroof_ros.simulation.inputs import INPUTS

if TYPE_CHECKING:
    import polars

REFERENCES = "scenarios.csv"
"""file in ``config/`` with the scores of the scenarios' controllers"""
_COLUMNS = ("scenario", "controller", "score", "bound", "stress_hours")
_MAINS = "mains_m3"
# Maximum number of time blocks with a variable of their own when a bound is computed.
_BLOCKS = 5000


@dataclass(frozen=True)
class Scenario:
    """A fixed site, weather, period and forecast, with a score.

    A scenario cannot be changed, so a score means the same to everyone.

    Example:
        >>> import greenroof_ros as gr
        >>> list(gr.scenarios)[:3]
        ['paper', 'july-2021', 'season-forecasts']
        >>> paper = gr.scenarios["paper"]
        >>> round(paper.evaluate(gr.simulate("onoff", **paper.inputs)), 2), paper.unit
        (3.23, 'mm')

    Attributes:
        name: name of the scenario.
        about: description in one sentence.
        unit: unit of the score.
        score: description of the score; lower is better.
        weights: weights of the metrics in the weighted sum that forms the score, by metric.
        controllers: inputs of the reference controllers, by name.
    """

    name: str
    about: str
    unit: str
    score: str
    weights: Mapping[str, float] = field(repr=False)
    controllers: Mapping[str, Mapping[str, Any]] = field(repr=False)
    _inputs: dict[str, Any] = field(repr=False)

    @property
    def inputs(self) -> dict[str, Any]:
        """Inputs of :func:`.simulate`, apart from the controller; a copy each time."""
        return deepcopy(self._inputs)

    def evaluate(self, result: Result) -> float:
        """Return the score of a run in this scenario."""
        return sum(weight * result.metrics[name] for name, weight in self.weights.items())

    def bound(self, result: Result) -> float:
        """Return the lowest score that is possible in this scenario.

        For the deviation, the bound is the minimum over all commands up to 1, or up to the highest
        command in the result if that is higher. For storm water, it is the minimum over all
        possible valve commands, given the irrigation in the result, and it excludes the term for
        water stress.
        """
        run, metrics = result.run, result.metrics
        if _MAINS in self.weights:
            price = self.weights[_MAINS]
            (point,) = bound_discharge(run, result.ticks, [price])
            return point.wet_discharge_m3 + price * point.mains_m3
        block_s = max(BLOCK_S, run.steps * run.site.tau / _BLOCKS)
        total = clairvoyant_bound(run, block_s, max(1.0, metrics["max_command"]))
        return metrics["mean_deviation_mm"] * total / metrics["total_deviation_m3"]


def _read_scenarios() -> dict[str, Scenario]:
    config = shared_directory() / "config"
    content = read_yaml(config / "scenarios.yaml")
    scenarios = {}
    for name, entry in content["scenarios"].items():
        site, run, score = {**entry["site"]}, entry["run"], entry["score"]
        inputs = {
            "site": read_site(config / site.pop("file"), **site),
            "weather": str(config / "weather" / entry["weather"]),
            **run,
        }
        if Path(inputs.get("forecast", "")).suffix:
            inputs["forecast"] = str(config / inputs["forecast"])
        scenarios[name] = Scenario(
            name, entry["about"], score["unit"], score["about"], score["weights"],
            entry["controllers"], inputs,
        )
    return scenarios


scenarios: Mapping[str, Scenario] = MappingProxyType(_read_scenarios())
"""scenarios by name"""


@dataclass(frozen=True, eq=False)
class Score:
    """The score of a controller in a scenario, printed with those of the reference controllers.

    Attributes:
        scenario: the scenario.
        name: name of the controller.
        value: score in the scenario's unit; lower is better.
        bound: lowest score that is possible with this irrigation; see :meth:`Scenario.bound`.
        result: the run and its results.
    """

    scenario: Scenario
    name: str
    value: float
    bound: float
    result: Result

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """Rows for this controller and the reference controllers, with the best score first."""
        own = (
            self.scenario.name, f"yours: {self.name}", self.value, self.bound,
            self.result.metrics["stress_hours"],
        )
        others = [row for row in read_references() if row["scenario"] == self.scenario.name]
        rows = [*others, dict(zip(_COLUMNS, own, strict=True))]
        return sorted(rows, key=lambda row: float(row["score"]))

    @property
    def table(self) -> polars.DataFrame:
        """The rows as a polars data frame: controller, score, bound and hours of water stress.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        return make_frame(self.rows).drop("scenario")

    def __repr__(self) -> str:
        """Return the score on one line, with the table below it."""
        known = self.scenario
        lines = [
            f"{known.name}: {self.value:.2f} {known.unit}, at best {self.bound:.2f}. The score is "
            f"the {known.score}; lower is better.",
            f"{'score':>8}{'at best':>9}{'stress':>9}  controller",
        ]
        lines += [
            f"{row['score']:8.2f}{row['bound']:9.2f}{row['stress_hours']:7.0f} h  "
            f"{row['controller']}"
            for row in self.rows
        ]
        return "\n".join(lines)


def read_references() -> list[dict[str, Any]]:
    """Return the scores of the reference controllers of all scenarios, one row per controller."""
    lines = read_lines(shared_directory() / "config" / REFERENCES)
    return [
        {name: text if name in _COLUMNS[:2] else float(text) for name, text in row.items()}
        for row in csv.DictReader(line for line in lines if not line.startswith("#"))
    ]


def score(
    controller: str | type | Controller | Function, scenario: str, **parameters: Any
) -> Score:
    """Return the score of a controller in a scenario, with the bound and other controllers' scores.

    Args:
        controller: any controller that :func:`.simulate` accepts.
        scenario: name of one of ``gr.scenarios``.
        parameters: parameters of the controller and of the valve's policy, such as
            ``outlet="plan"``.

    Returns:
        The score, its bound, the run, and a table with the scores of the reference controllers.

    Raises:
        ConfigurationError: if there is no such scenario, or if a parameter is invalid or is fixed
            by the scenario.

    Example:
        >>> import greenroof_ros as gr
        >>> def dry(state, forecast):
        ...     return 1.0 if state.roof_level < 0.9 * state.site.z_veg else 0.0
        >>> found = gr.score(dry, "paper")
        >>> found.bound <= found.value < gr.score("onoff", "paper").value
        True
    """
    if not isinstance(scenario, str) or scenario not in scenarios:
        raise ConfigurationError(
            describe_choices([*scenarios], str(scenario)), key="scenario", value=scenario
        )
    for name, value in parameters.items():
        if name in INPUTS:
            raise ConfigurationError("is fixed by the scenario", key=name, value=value)
    return evaluate(scenarios[scenario], controller, parameters)


def evaluate(
    scenario: Scenario, controller: str | type | Controller | Function,
    inputs: Mapping[str, Any],
) -> Score:
    """Simulate a controller in a scenario and return its score.

    Args:
        scenario: the scenario.
        controller: the controller.
        inputs: parameters of the controller, and inputs that replace those of the scenario, by
            name.

    Raises:
        ConfigurationError: if an input is invalid.
        NoBoundError: if the solver cannot find the bound.
    """
    result = simulate(controller, **{**scenario.inputs, **inputs})
    return Score(
        scenario, result.run.controller.name, scenario.evaluate(result), scenario.bound(result),
        result,
    )
