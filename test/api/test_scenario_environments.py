"""A scenario as an environment: what is trained on is what is scored."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import refusal

import greenroof_ros as gr

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")

ID, VECTOR_ID = "greenroof_ros.gym:GreenRoof-v1", "greenroof_ros.gym:GreenRoofVector-v1"


def play(
    roof: Any, seed: int | None = None, policy: Callable[[Any], Any] | None = None,
    actions: int = 1,
) -> tuple[float, dict[str, Any]]:
    """Play an episode; return the cost by its rewards, and its last info.

    The policy chooses an action for an observation; by default actions are random.
    """
    chance = np.random.default_rng(actions)
    policy = policy or (lambda _: chance.random(roof.action_space.shape))
    observation, info = roof.reset(seed=seed)
    cost, ended = info["initial_score"], False
    while not ended:
        observation, reward, _, ended, last = roof.step(policy(observation))
        cost -= reward
    return cost, last


@pytest.mark.parametrize("name", [*gr.scenarios])
def test_the_rewards_add_up_to_the_score(name: str) -> None:
    """Whatever the seed of the reset, and without a warning; the result is that of the episode."""
    ticks = 20 if gr.scenarios[name].run["hours"] > 1000 else 7
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        roof = gymnasium.make(ID, scenario=name, decision_ticks=ticks).unwrapped
        ends = [play(roof, seed, actions=actions) for seed, actions in ((None, 1), (11, 1), (0, 2))]
    assert ends[0] == ends[1]
    for cost, last in ends[1:]:
        assert cost == pytest.approx(last["score"], rel=0, abs=1e-9)
    assert ends[2][0] != ends[1][0]
    result = gr.scenarios[name].evaluate(roof.result())
    assert result == pytest.approx(ends[2][0], rel=0, abs=1e-9)


class Policy:
    """A model, as of stable-baselines3: on/off at a share of the target, with a closed valve."""

    observation_space = None

    def predict(self, observation: Any, state: Any = None, deterministic: bool = False) -> Any:
        assert deterministic and observation.dtype == np.float32
        return np.array([float(observation[1] < 0.45), 0.0], np.float32), None


class Plain:
    """A model of one's own, which returns (command, outlet)."""

    def predict(self, observation: Any) -> tuple[float, float]:
        return float(observation[1] < 0.45), 0.0


def test_models_functions_and_classes_of_the_same_policy_have_one_score() -> None:
    """An observation is half of the share of the target, in 32 bits, which no level touches."""

    def function(state: Any, forecast: Any) -> tuple[float, Any]:
        return float(state.roof_level < 0.9 * state.site.z_veg), np.array([0.0])

    class Mine:
        parameters = ()
        outlet = 1.0

        def __init__(self, site: Any) -> None:
            self.site = site

        def command(
            self, cistern: float, roof: float, rain: np.ndarray, dried: np.ndarray
        ) -> tuple[float, float]:
            return float(roof < 0.9 * self.site.z_veg), 0.0

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scores = [gr.score(each, "dry-month") for each in (function, Mine, Plain())]
    assert len({each.value for each in scores}) == 1
    roof = gymnasium.make(ID, scenario="dry-month").unwrapped
    cost, _ = play(roof, 5, Plain().predict)
    assert cost == pytest.approx(scores[0].value, rel=0, abs=1e-9)
    # With a decision in every hour, a policy is another one.
    Policy.observation_space = roof.observation_space
    hourly = gr.score(Policy(), "dry-month", decision_ticks=12)
    assert hourly.value != scores[0].value
    refusal(
        lambda: gr.score(Policy(), "dry-month", horizon=6),
        match=r"the model: takes observations of shape .* give the horizon of its training",
    )


def test_rewards_count_the_mains_water_of_other_uses() -> None:
    """A cistern without a mains top-up, which other uses empty, and all that they need then."""
    site = gr.read_site("site_valve.yaml", other_demand=50_000.0, tau=300.0)
    site = replace(site, mains_level=None, mains_flow=None)
    roof = gymnasium.make(ID, site=site, hours=48).unwrapped
    cost, info = play(roof, policy=lambda _: [0.0, 0.0])
    metrics = info["metrics"]
    assert metrics["mains_m3"] > 1
    expected = (
        metrics["wet_discharge_m3"] + 0.3 * metrics["mains_m3"] + 0.01 * metrics["stress_hours"]
    )
    assert cost == pytest.approx(expected, rel=0, abs=1e-9)


def test_no_episode_of_the_training_reaches_the_scenario() -> None:
    """A longer one could; and what a scenario fixes, no reset changes."""
    long = gymnasium.make(ID, scenario="dry-month", start="random", hours=9000)
    refusal(lambda: long.reset(seed=31), match="hours = 9000.*from 0 to 744 h")
    fixed = gymnasium.make(ID, scenario="dry-month")
    refusal(lambda: fixed.reset(options={"initial": "low-low"}), match="fixed by the scenario")


def test_seeds_have_a_mean_and_a_spread() -> None:
    """Which are those of the seeds' own scores; an environment draws one of them."""
    known = gr.scenarios["dry-month"]

    def in_dry_days(state: Any, forecast: Any) -> tuple[float, float]:
        return float(state.roof_level < state.site.z_veg and not forecast.rain.any()), 0.0

    found = gr.score(in_dry_days, "dry-month", seeds=[1, 3], horizon=24)
    assert found.values == [
        known.evaluate(gr.simulate(in_dry_days, horizon=24, **{
            **known.inputs, "forecast_seed": seed,
        })) for seed in (1, 3)
    ]
    assert found.values[0] != found.values[1]
    assert found.value == pytest.approx(sum(found.values) / 2)
    assert "with 2 seeds" in repr(found)
    first = {
        draw: gymnasium.make(ID, scenario="dry-month", draw=draw).reset(seed=draw)[0].tolist()
        for draw in (None, 1, 3)
    }
    assert first[None] == first[1] != first[3]
    for seeds in (0, 1.5, []):
        refusal(lambda seeds=seeds: gr.score("onoff", "dry-month", seeds=seeds), match="seeds")
    refusal(lambda: gr.score("onoff", "paper", seeds=2), match="forecast_seed = 1: is an option of")


def test_training_years_are_not_the_tests() -> None:
    """A season begins on the scenario's first day; a shorter episode at any hour within it."""
    known = gr.scenarios["season-valve"]
    roof = gymnasium.make(ID, scenario="season-valve", start="random").unwrapped
    starts = {roof.reset(seed=seed)[1]["start"] for seed in range(40)}
    assert starts <= {f"{year}-05-01T00:00:00-05:00" for year in known.train["years"]}
    assert len(starts) > 6 and 2021 not in known.train["years"]
    roofs = gymnasium.make_vec(
        VECTOR_ID, num_envs=40, scenario="dry-month", start="random", hours=240
    )
    drawn = [datetime.fromisoformat(start) for start in roofs.reset(seed=1)[1]["start"]]
    assert {each.year for each in drawn} <= {*known.train["years"]} and len({*drawn}) > 30
    for each in drawn:
        assert each.month == 8 and 0 <= (each.day - 1) * 24 + each.hour <= 744 - 240
    refusal(
        lambda: gymnasium.make(ID, scenario="paper", start="random"), match="no years to train on"
    )


def test_a_random_start_makes_its_forecast_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from greenroof_ros.forecast.models import ErrorModel

    made, begin = [], ErrorModel.__init__
    monkeypatch.setattr(
        ErrorModel, "__init__", lambda *given: made.append(1) or begin(*given)
    )
    roof = gymnasium.make(ID, scenario="dry-month", start="random", hours=24)
    for seed in range(3):
        roof.reset(seed=seed)
        assert len(made) == seed + 1


def test_what_each_step_tells() -> None:
    """Of storm water and stress, in the vector environment, too; sums are the last metrics."""
    roof = gymnasium.make(ID, scenario="storm-minutes", decision_ticks=10).unwrapped
    roofs = gymnasium.make_vec(VECTOR_ID, num_envs=2, scenario="storm-minutes", decision_ticks=10)
    roof.reset()
    roofs.reset()
    names, ended, action = ("wet_discharge_m3", "mains_m3", "stress_hours"), False, [0.0, 0.5]
    told = []
    while not ended:
        *_, ended, info = roof.step(np.array(action))
        *_, infos = roofs.step(np.array([action] * 2))
        told.append([info[name] for name in names])
        assert told[-1] == [infos[name][1] for name in names]
    for name, total in zip(names, np.sum(told, axis=0), strict=True):
        assert total == pytest.approx(info["metrics"][name], abs=1e-9)
    assert infos["score"].tolist() == [info["score"]] * 2


@pytest.mark.parametrize(("inputs", "reason"), [
    ({"decision_tick": 3}, "decision_tick = 3: is not an input; did you mean decision_ticks"),
    ({"decision_ticks": True}, "decision_ticks.*: must be a"),
    ({"decision_ticks": 0}, "decision_ticks.*: must be a"),
    ({"site": gr.read_site("site_valve.yaml"), "outlet": "drain"}, "outlet = 'drain': is not an"),
    ({"scenario": "dry-months"}, "did you mean dry-month"),
    ({"scenario": "dry-month", "hours": 3}, "hours = 3: is fixed by the scenario"),
    ({"scenario": "dry-month", "site": "site.yaml"}, "site = .*: is fixed by the scenario"),
    ({"draw": 2}, "forecast_seed = 2: is an option of errors and ensemble"),
])
def test_refused_inputs(inputs: dict[str, Any], reason: str) -> None:
    refusal(lambda: gymnasium.make(ID, **inputs), match=reason)


def test_a_reward_must_be_finite() -> None:
    roof = gymnasium.make(ID, hours=1, reward=lambda tick, state: math.nan)
    roof.reset()
    refusal(lambda: roof.step(np.array([0.5])), match="rewards.*: must be finite numbers")


def test_a_given_seed_holds() -> None:
    roof = gymnasium.make(ID, hours=1, forecast="errors", horizon=48, forecast_seed=4)
    assert roof.reset(seed=1)[0].tolist() == roof.reset(seed=2)[0].tolist()


def test_a_model_knows_the_forecast_and_not_the_rain() -> None:
    """Rain in the model is that of the forecast, over each of its steps and in all."""
    inputs = {"start": "2021-07-07T02:00", "hours": 40, "horizon": 12, "forecast": "errors",
              "site": gr.read_site(tau=60.0, M=1)}
    roof, truth = gr.Environment(**inputs), gr.simulate("onoff", **inputs | {
        "horizon": None, "forecast": None,
    }).ticks.precipitation
    apart = []
    for k in range(1500):
        if k % 97 == 0:
            forecast, model = roof.forecast, roof.model()
            rain = []
            while not model.done:
                rain.append(model.step(1.0).precipitation)
            assert len(rain) == 12 * 60
            fallen = np.interp(forecast.ends / 60, np.arange(721), np.append(0, np.cumsum(rain)))
            expected = np.append(0, np.cumsum(forecast.rain * np.diff(forecast.ends)))
            assert 60 * fallen == pytest.approx(expected, rel=1e-9, abs=1e-12)
            apart.append(abs(np.sum(rain) - truth[k : k + 720].sum()) * 60 * 1000)
        roof.step(0.0)
    assert max(apart) > 1  # mm: the forecasts have errors
    assert roof.state.time.isoformat() == "2021-07-08T03:00:00-05:00"  # a model leaves it alone


def test_an_environments_result_is_a_runs() -> None:
    """As of a function with the same commands, apart from the tick at the end."""
    inputs = {**gr.scenarios["storm-minutes"].inputs, "outlet": "drain"}
    roof = gr.Environment(**inputs)
    refusal(roof.result, match="the run: has a result only after its last tick")
    while not roof.done:
        roof.step(float(roof.state.roof_level < 0.9 * roof.site.z_veg))
    found, expected = roof.result(), gr.simulate(
        lambda state, forecast: float(state.roof_level < 0.9 * state.site.z_veg), **inputs
    )
    assert found.metrics == expected.metrics == roof.metrics
    assert found.events.equals(expected.events)
    one, other = found.trajectory, expected.trajectory
    assert one.columns == other.columns and one[:-1].equals(other[:-1])
    assert one["roof_m3", "cistern_m3"].equals(other["roof_m3", "cistern_m3"])
    assert {"mains_flow_m3_per_s", "wet", "outlet_command"} <= {*one.columns}
    mains = 60 * one["mains_flow_m3_per_s"][:-1].sum()
    assert mains == pytest.approx(found.metrics["mains_m3"], abs=1e-12)
    assert gr.scenarios["storm-minutes"].evaluate(found) == pytest.approx(
        60 * (one["outflow_m3_per_s"] + one["drainage_m3_per_s"]).to_numpy()[:-1]
        @ one["wet"].to_numpy()[:-1] + 0.3 * mains + 0.01 * found.metrics["stress_hours"]
    )


def test_a_part_of_a_run_as_a_chart() -> None:
    """With the opening of the valve as a panel, if it opens."""
    result = gr.simulate("onoff", **gr.scenarios["storm-minutes"].inputs, outlet="drain")
    described = result.plot("2019-07-29T20:00", datetime(2019, 7, 30, 2)).to_dict()  # noqa: DTZ001
    assert len(described["vconcat"]) == 6
    times = [row["t"] for rows in described["datasets"].values() for row in rows if "t" in row]
    assert (max(times) - min(times)) / 3.6e6 == 6.0
    refusal(lambda: result.plot("2020-01-01T00:00"), match="start and end: must include two")


def test_packaged_files_are_found_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From any folder."""
    monkeypatch.chdir(tmp_path)
    roof = gr.Environment(
        site="site_valve.yaml", weather="config/weather/toronto_2021.csv", hours=1,
        start="2021-07-07",
    )
    assert roof.site.a_in == 300.0
