"""The environment GreenRoof-v1 in Gymnasium's own checks, alone and vectorised."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paper import IMPERFECT, LIMITED_SOIL, LIMITED_VALVE, LIMITED_WHOLE, VALVE, four_days

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")

RECORD = Path(__file__).parents[1] / "data" / "en_climate_hourly_07-2021.csv"
ID = "greenroof_ros.gym:GreenRoof-v1"
VALVE_SITE = gr.read_site(**VALVE)


@pytest.mark.parametrize("inputs", [
    {"forecast": "perfect"}, {"forecast": "errors"}, {"site": VALVE_SITE, "decision_ticks": 60},
])
def test_gymnasiums_check_finds_nothing(inputs: dict[str, Any]) -> None:
    """Not even a warning."""
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        roof = gymnasium.make(ID, hours=0.5, horizon=0.5, **inputs)
        check_env(roof.unwrapped)


def test_rewards_add_up_to_the_deviation() -> None:
    """On/off scores what the controller does.

    The rewards lack the first tick, whose deviation is x2* (1 - 1 / 1.3), Table II.
    """
    roof = gymnasium.make(ID, hours=2)
    roof.reset(seed=7)
    total, ended = 68.8 * 0.0457 * (1 - 1 / 1.3), False
    while not ended:
        level = roof.unwrapped._roofs.states[0].roof_level
        command = np.array([1.0 if level < roof.unwrapped.site.z_veg else 0.0])
        _, reward, terminated, ended, info = roof.step(command)
        total -= float(reward)
        assert not terminated
    assert info["metrics"] == gr.simulate("onoff", hours=2).metrics
    assert total == pytest.approx(info["metrics"]["total_deviation_m3"])
    with pytest.raises(ConfigurationError, match="the run: has ended"):
        roof.step(command)


def test_observation() -> None:
    """Shares of the ranges: levels, then 3.2 mm of rain in the three hours from 02:00."""
    roof = gymnasium.make(ID, hours=1, horizon=3)
    observation, _ = roof.reset()
    assert observation.dtype == np.float32
    lengths = np.diff(roof.unwrapped.ends) / 3600
    assert observation[:2] == pytest.approx([1 / 1.3 / 1.5, 1 / 1.3 / 2])
    rain, dry = np.split(observation[2:], 2)
    assert 50 * rain @ lengths == pytest.approx(3.2)
    assert 12 * dry @ lengths == pytest.approx(2.77537901 + 3.44779366 + 1.22675507)


@pytest.mark.parametrize(("entries", "action"), [
    (1, [1.1]), (1, [-0.1]), (1, 0.5), (1, [np.nan]), (1, [None]), (2, [0.5]), (2, [0.5, 1.2]),
])
def test_refused_actions(entries: int, action: Any) -> None:
    """A refused action changes nothing."""
    roof = gymnasium.make(ID, hours=1, site=VALVE_SITE if entries == 2 else None).unwrapped
    roof.reset()
    with pytest.raises(ConfigurationError, match=rf"action: .*shape \({entries},"):
        roof.step(np.array(action))
    assert roof._roofs.tick == 0


def made() -> Any:
    return gymnasium.make(ID, hours=1, decision_ticks=60, start="random", weather=str(RECORD))


@pytest.mark.parametrize("context", ["spawn", "fork"])
def test_random_starts_in_workers_that_know_nothing(context: str) -> None:
    """Of which each draws its own."""
    roofs = gymnasium.vector.AsyncVectorEnv([made, made], context=context)
    _, drawn = roofs.reset(seed=3)
    roofs.close()
    alone = [made().reset(seed=seed)[1] for seed in (3, 4)]
    assert [each["start"] for each in alone] == list(drawn["start"])
    assert alone[0]["start"] != alone[1]["start"]


def of_deviation(tick: Any, state: Any) -> float:
    return -abs(state.roof - state.site.x2_star)


def of_storm_water(tick: Any, state: Any) -> float:
    """The score for storm water in doc/reference/scenarios.md, of a tick."""
    site, flows = state.site, tick.flows
    wet = tick.wet * (flows.outflow + (1 - site.drainage_to_cistern) * flows.drainage)
    return -site.tau * (wet + 0.3 * flows.mains + tick.stress * 0.01 / 3600)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("site", [VALVE_SITE, LIMITED_VALVE, LIMITED_WHOLE, LIMITED_SOIL])
def test_a_decision_is_the_sum_of_its_ticks(site: Any) -> None:
    """A function as the reward is asked tick by tick, and the default is not: bit for bit, except
    that storm water is added up in another order.
    """
    of_roof = not site.low_outlet_valve
    inputs = {"site": site, "weather": four_days(), "start": "random", "decision_ticks": 37,
              "hours": 8, **IMPERFECT}
    roofs = [
        gymnasium.make(ID, **inputs, **given) for given in (
            {}, {"reward": of_storm_water if site.low_outlet_valve else of_deviation},
        )
    ]
    for seed in (1, 2):
        assert len({roof.reset(seed=seed)[0].tobytes() for roof in roofs}) == 1
        ended = False
        while not ended:
            action = roofs[0].action_space.sample()
            ours, theirs = (roof.step(action) for roof in roofs)
            assert ours[0].tobytes() == theirs[0].tobytes() and ours[2:] == theirs[2:]
            assert ours[1] == pytest.approx(theirs[1], rel=0 if of_roof else 1e-9, abs=1e-12)
            ended = ours[3]


def test_options_of_an_episode() -> None:
    roof = gymnasium.make(ID, hours=1)
    info = roof.reset(options={"initial": "high-high", "start": "2021-07-08T02:00"})[1]
    assert info == {  # Table II
        "start": "2021-07-08T02:00:00-05:00", "cistern_m3": pytest.approx(1.3 * 75),
        "roof_m3": pytest.approx(1.3 * 68.8 * 0.0457),
        "initial_score": pytest.approx(0.3 * 68.8 * 0.0457),
    }
    assert roof.reset()[1]["start"] == "2021-07-07T02:00:00-05:00"
    with pytest.raises(ConfigurationError, match="option = 'beginning': must be start or in"):
        roof.reset(options={"beginning": 1})


def test_the_second_entry_commands_the_valve() -> None:
    """As Environment.step does; the observation ends with how long the weather remains wet.

    Rain of 07 July ends at 05:00 and at 10:00; two hours later it is dry. The run begins between.
    """
    inputs = {"site": VALVE_SITE, "start": "2021-07-07T08:00", "hours": 5}
    roof, same = gymnasium.make(ID, decision_ticks=1800, **inputs), gr.Environment(**inputs)
    assert roof.action_space.shape == (2,)
    assert gymnasium.make(ID, hours=1).action_space.shape == (1,)
    observation, _ = roof.reset()
    assert observation[-1] == 0.0
    assert roof.reset(options={"start": "2021-07-07T06:00"})[0][-1] == 0.5
    assert roof.reset()[0][-1] == 0.0
    ended, wet = False, []
    while not ended:
        action = roof.action_space.sample()
        observation, *_, ended, info = roof.step(action)
        for _ in range(1800):
            same.step(*map(float, action))
        wet.append(observation[-1])
    assert wet == pytest.approx([1, 1, 1, 1, 0.75, 0.5, 0.25, 0, 0, 0], abs=1e-3)
    assert info["metrics"] == same.metrics


@pytest.mark.parametrize("inputs", [{}, {"site": VALVE_SITE}])
@pytest.mark.parametrize("copied", [
    copy.deepcopy, lambda roof: pickle.loads(pickle.dumps(roof)),
])
def test_a_copy_goes_on(copied: Callable[[Any], Any], inputs: dict[str, Any]) -> None:
    """Also into the next episode, whose errors are drawn from the copied random numbers."""
    roof = gymnasium.make(ID, hours=0.1, decision_ticks=7, forecast="errors", **inputs)
    roof.reset(seed=2)
    shape = roof.action_space.shape
    roof.step(np.full(shape, 0.7))
    played = []
    for each in (copied(roof), roof):
        steps, ended = [], False
        while not ended:
            observation, reward, _, ended, _ = each.step(np.full(shape, 0.3))
            steps.append((observation.tobytes(), reward))
        played.append((steps, each.reset()[0].tobytes()))
    assert played[0] == played[1]


def test_seeds_draw_the_errors_of_forecasts() -> None:
    roof = gymnasium.make(ID, hours=1, forecast="errors", horizon=48)
    drawn = [roof.reset(seed=seed)[0].tolist() for seed in (1, 2, 1, None, None)]
    assert drawn[0] == drawn[2]
    assert len({tuple(each) for each in drawn}) == 4
