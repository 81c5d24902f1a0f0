"""Scenarios: fixed runs with a score, its lower bound, and the scores of reference controllers.

``config/scenarios.yaml`` defines the scenarios. ``config/scenarios.csv`` lists the scores of the
reference controllers, which ``tools/reference_scores.py`` computes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from greenroof_ros.api.simulate import Function, Result, read_site, simulate
from greenroof_ros.base.errors import ConfigurationError, describe_choices, require_extra
from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.simulation.bound import BLOCK_S, bound_discharge, clairvoyant_bound
from greenroof_ros.simulation.inputs import INPUTS

with require_extra("study"):
    import polars

_CONFIG = shared_directory() / "config"
REFERENCES = _CONFIG / "scenarios.csv"
"""file with the scores of the scenarios' controllers"""
# Maximum number of time blocks with a variable of their own when a bound is computed.
_BLOCKS = 5000


@dataclass(frozen=True)
class Scenario:
    """A fixed site, weather, period and forecast, with a score.

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
        site: file of the site, and the values that replace those in the file.
        weather: file of the weather.
        run: other inputs of a simulation.
    """

    name: str
    about: str
    unit: str
    score: str
    weights: Mapping[str, float] = field(repr=False)
    controllers: Mapping[str, Mapping[str, Any]] = field(repr=False)
    site: Mapping[str, Any] = field(repr=False)
    weather: str = field(repr=False)
    run: Mapping[str, Any] = field(repr=False)

    @property
    def inputs(self) -> dict[str, Any]:
        """Inputs of :func:`.simulate`, apart from the controller; new ones each time."""
        changes = {**self.site}
        inputs = {
            "site": read_site(_CONFIG / changes.pop("file"), **changes),
            "weather": str(_CONFIG / "weather" / self.weather), **self.run,
        }
        if (_CONFIG / (archive := inputs.get("forecast", ""))).is_file():
            inputs["forecast"] = str(_CONFIG / archive)
        return inputs

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
        if price := self.weights.get("mains_m3"):
            (point,) = bound_discharge(run, result.ticks, [price])
            return point.wet_discharge_m3 + price * point.mains_m3
        block_s = max(BLOCK_S, run.steps * run.site.tau / _BLOCKS)
        total = clairvoyant_bound(run, block_s, max(1.0, metrics["max_command"]))
        return metrics["mean_deviation_mm"] * total / metrics["total_deviation_m3"]


scenarios = {
    name: Scenario(name=name, **{**entry, **entry["score"]})
    for name, entry in read_yaml(_CONFIG / "scenarios.yaml")["scenarios"].items()
}
"""scenarios by name"""


@dataclass(frozen=True, eq=False)
class Score:
    """The score of a controller in a scenario, printed with those of the reference controllers.

    Attributes:
        scenario: the scenario.
        result: the run and its results.
    """

    scenario: Scenario
    result: Result

    @property
    def value(self) -> float:
        """The score in the scenario's unit; lower is better."""
        return self.scenario.evaluate(self.result)

    @cached_property
    def bound(self) -> float:
        """The lowest score that is possible with this irrigation; see :meth:`Scenario.bound`."""
        return self.scenario.bound(self.result)

    @cached_property
    def table(self) -> polars.DataFrame:
        """Score, bound and hours of stress of all controllers in the scenario, the best first."""
        own = polars.DataFrame({
            "controller": f"yours: {self.result.run.controller.name}", "score": self.value,
            "bound": self.bound, "stress_hours": self.result.metrics["stress_hours"],
        })
        others = read_references().filter(scenario=self.scenario.name).drop("scenario")
        return polars.concat([others, own]).sort("score", maintain_order=True)

    def __repr__(self) -> str:
        """Return the score on one line, with the table below it."""
        known = self.scenario
        rows = [
            f"{score:8.2f}{bound:9.2f}{stress:7.0f} h  {name}"
            for name, score, bound, stress in self.table.rows()
        ]
        return "\n".join([
            f"{known.name}: {self.value:.2f} {known.unit}, at best {self.bound:.2f}. The score is "
            f"the {known.score}; lower is better.",
            f"{'score':>8}{'at best':>9}{'stress':>9}  controller", *rows,
        ])


def read_references() -> polars.DataFrame:
    """Return the scores of the reference controllers of all scenarios, one row per controller."""
    return polars.read_csv(REFERENCES, comment_prefix="#")


def score(
    controller: str | type | Function, scenario: str, **parameters: Any
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
    if str(scenario) not in scenarios:
        raise ConfigurationError(
            describe_choices([*scenarios], str(scenario)), key="scenario", value=scenario
        )
    for name in parameters.keys() & INPUTS:
        raise ConfigurationError("is fixed by the scenario", key=name, value=parameters[name])
    known = scenarios[scenario]
    return Score(known, simulate(controller, **known.inputs, **parameters))
