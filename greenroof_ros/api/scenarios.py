"""Scenarios: fixed runs with a score, its lower bound, and the scores of reference controllers.

``config/scenarios.yaml`` defines the scenarios. ``config/scenarios.csv`` lists the scores of the
reference controllers, which ``tools/reference_scores.py`` computes.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from statistics import fmean
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from greenroof_ros.api.simulate import Result, choose_controller, read_site, simulate_run, warn
from greenroof_ros.base.errors import ConfigurationError, describe_choices, require_extra
from greenroof_ros.base.files import read_yaml, shared_directory
from greenroof_ros.base.ranges import Range
from greenroof_ros.controllers.protocol import note_arrays
from greenroof_ros.simulation.bound import BLOCK_S, bound_discharge, clairvoyant_bound
from greenroof_ros.simulation.inputs import INPUTS, make_inputs

if TYPE_CHECKING:
    import polars

_CONFIG = shared_directory() / "config"
REFERENCES = _CONFIG / "scenarios.csv"
"""file with the scores of the scenarios' controllers"""
# Maximum number of time blocks with a variable of their own when a bound is computed.
_BLOCKS = 5000
_COUNT = Range(1, 10_000, whole=True)


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
        train: ``weather`` and ``years`` to train on, apart from the year of the scenario; empty if
            there is no such record.
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
    train: Mapping[str, Any] = field(repr=False, default_factory=dict)

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

    @property
    def training_inputs(self) -> dict[str, Any]:
        """The inputs with the weather to train on, without a start and without a seed.

        Raises:
            ConfigurationError: if the scenario has no years to train on.
        """
        if not self.train:
            raise ConfigurationError("has no years to train on", key="scenario", value=self.name)
        inputs = {**self.inputs, "weather": str(_CONFIG / "weather" / self.train["weather"])}
        return {name: inputs[name] for name in inputs.keys() - {"start", "forecast_seed"}}

    def training_starts(self, hours: float) -> tuple[list[datetime], int]:
        """Return the first start in each year to train on, and the number of hourly starts.

        A run of some hours is then within the scenario's days of the year.

        Raises:
            ConfigurationError: if a run is longer than the scenario.
        """
        Range(0.0, self.run["hours"], "h").read(hours, key="hours")
        first, spare = datetime.fromisoformat(self.run["start"]), int(self.run["hours"] - hours)
        return [first.replace(year=year) for year in self.train["years"]], 1 + spare

    def evaluate(self, result: Result) -> float:
        """Return the score of a run in this scenario."""
        return weigh(self.weights, result.metrics)

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


_FILE = read_yaml(_CONFIG / "scenarios.yaml")
STORM_WATER: dict[str, float] = _FILE["scores"]["storm_water"]["weights"]
"""weights of the metrics in the score of a site with a valve"""
scenarios = {
    name: Scenario(name=name, **{**entry, **entry["score"]})
    for name, entry in _FILE["scenarios"].items()
}
"""scenarios by name"""


def weigh(weights: Mapping[str, float], metrics: Mapping[str, float]) -> float:
    """Return a weighted sum of metrics, those that a run lacks being 0."""
    return sum(weight * metrics.get(name, 0.0) for name, weight in weights.items())


def find_scenario(name: Any) -> Scenario:
    """Return the scenario of a name.

    Raises:
        ConfigurationError: if there is no such scenario.
    """
    if str(name) not in scenarios:
        wrong = describe_choices([*scenarios], str(name))
        raise ConfigurationError(wrong, key="scenario", value=name)
    return scenarios[name]


@dataclass(frozen=True, eq=False)
class Score:
    """The score of a controller in a scenario, printed with those of the reference controllers.

    Attributes:
        scenario: the scenario.
        results: the run and its results, for each seed of the forecasts' errors.
        name: name of the controller, with its parameters.
    """

    scenario: Scenario
    results: Sequence[Result]
    name: str = ""

    @property
    def result(self) -> Result:
        """The run with the first seed, and its results."""
        return self.results[0]

    @property
    def values(self) -> list[float]:
        """The score with each seed, in the scenario's unit; lower is better."""
        return [*map(self.scenario.evaluate, self.results)]

    @property
    def value(self) -> float:
        """The score, or its mean over the seeds."""
        return fmean(self.values)

    @cached_property
    def bound(self) -> float:
        """The lowest score that is possible with this irrigation; see :meth:`Scenario.bound`.

        With several seeds, it is the mean of their bounds.
        """
        return fmean(map(self.scenario.bound, self.results))

    @cached_property
    def table(self) -> polars.DataFrame:
        """Score, bound and hours of stress of all controllers in the scenario, the best first.

        Raises:
            ConfigurationError: if polars is not installed.
        """
        others = read_references().filter(scenario=self.scenario.name).drop("scenario")
        stress = fmean(each.metrics["stress_hours"] for each in self.results)
        own = [(f"yours: {self.name}", self.value, self.bound, stress)]
        import polars  # which has read the others

        row = polars.DataFrame(own, schema=others.schema, orient="row")
        return others.vstack(row).sort("score", maintain_order=True)

    def __repr__(self) -> str:
        """Return the score on one line, with the table below it."""
        known, values, spread = self.scenario, self.values, ""
        if len(values) > 1:
            spread = f" ({min(values):.2f} to {max(values):.2f} with {len(values)} seeds)"
        rows = [
            f"{score:8.2f}{bound:9.2f}{stress:7.0f} h  {name}"
            for name, score, bound, stress in self.table.rows()
        ]
        return "\n".join([
            f"{known.name}: {self.value:.2f} {known.unit}{spread}, at best {self.bound:.2f}. The "
            f"score is the {known.score}; lower is better.",
            f"{'score':>8}{'at best':>9}{'stress':>9}  controller", *rows,
        ])


def read_references() -> polars.DataFrame:
    """Return the scores of the reference controllers of all scenarios, one row per controller.

    Raises:
        ConfigurationError: if polars is not installed.
    """
    with require_extra("study"):
        import polars
    return polars.read_csv(REFERENCES, comment_prefix="#")


def score(
    controller: Any, scenario: str, *, seeds: int | Iterable[int] | None = None, **parameters: Any
) -> Score:
    """Return the score of a controller in a scenario, with the bound and other controllers' scores.

    Args:
        controller: any controller that :func:`.simulate` accepts; or a model with a method
            ``predict(observation)`` that was trained on ``GreenRoof-v1``, such as those of
            stable-baselines3.
        scenario: name of one of ``gr.scenarios``.
        seeds: seeds of the forecasts' errors, over which the score is averaged: a number n for the
            seeds 1 to n, or the seeds; by default the scenario's own, which is 1.
        parameters: parameters of the controller and of the valve's policy, such as
            ``outlet="plan"``; for a model, the ``horizon`` and the ``decision_ticks`` of the
            environment on which it was trained.

    Returns:
        The score, its bound, the runs, and a table with the scores of the reference controllers.

    Raises:
        ConfigurationError: if there is no such scenario, if a parameter is invalid or is fixed by
            the scenario, or if the scenario has no seeds.

    Example:
        >>> import greenroof_ros as gr
        >>> def dry(state, forecast):
        ...     return 1.0 if state.roof_level < 0.9 * state.site.z_veg else 0.0
        >>> found = gr.score(dry, "paper")
        >>> found.bound <= found.value < gr.score("onoff", "paper").value
        True
    """
    known = find_scenario(scenario)
    for name in parameters.keys() & INPUTS:
        raise ConfigurationError("is fixed by the scenario", key=name, value=parameters[name])
    draws: list[Any] = [None]
    if isinstance(seeds, Iterable):
        draws = [*seeds]
    elif seeds is not None:
        draws = [*range(1, 1 + int(_COUNT.read(seeds, key="seeds")))]
    if not draws:
        raise ConfigurationError("must be at least one seed", key="seeds", value=seeds)
    if hasattr(controller, "predict") and not isinstance(controller, type):
        results = [_play(controller, known, {**parameters, "draw": draw}) for draw in draws]
        name = type(controller).__name__
    else:
        choice = choose_controller(controller)
        warn(note_arrays(choice.kind), level=3)
        drawn = [{} if draw is None else {"forecast_seed": draw} for draw in draws]
        results = [
            simulate_run(make_inputs(choice, {**known.inputs, **inputs, **parameters}).build())
            for inputs in drawn
        ]
        name = choice.name
    return Score(known, results, ", ".join(
        [name, *(f"{key}={value}" for key, value in parameters.items())]
    ))


def _play(model: Any, scenario: Scenario, settings: Mapping[str, Any]) -> Result:
    """Return the result of a model's actions in the environment of a scenario."""
    with require_extra("gym"):
        import gymnasium

    made = gymnasium.make("greenroof_ros.gym:GreenRoof-v1", scenario=scenario.name, **settings)
    roof: Any = made.unwrapped
    space = getattr(model, "observation_space", roof.observation_space)
    if space.shape != roof.observation_space.shape:
        raise ConfigurationError(
            f"takes observations of shape {space.shape}, but those of the scenario have shape "
            f"{roof.observation_space.shape}; give the horizon of its training", key="the model",
        )
    predict, ended = model.predict, False
    # stable-baselines3 would otherwise draw its actions, and returns (actions, state).
    is_drawn = "deterministic" in inspect.signature(predict).parameters
    fixed = {"deterministic": True} if is_drawn else {}
    observation, _ = roof.reset()
    while not ended:
        action = predict(observation, **fixed)
        if isinstance(action, tuple) and np.ndim(action[0]):
            action = action[0]
        observation, _, _, ended, _ = roof.step(np.reshape(action, -1))
    return cast("Result", roof.result())
