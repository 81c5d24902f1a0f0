"""The environment GreenRoof-v0 in Gymnasium's own checks, alone and vectorised."""

from __future__ import annotations

import doctest
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import greenroof_ros as gr

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")
gymnasium.register_envs(gr.gym)

ID = "GreenRoof-v0"


@pytest.mark.parametrize("forecast", ["perfect", "errors"])
def test_gymnasiums_check_finds_nothing(forecast: str) -> None:
    """Not even a warning."""
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(ID, hours=0.5, horizon=0.5, forecast=forecast).unwrapped)


def played(policy: Callable[[Any, Any], Any], **inputs: Any) -> tuple[float, dict[str, float]]:
    """Play an episode; return the sum of its rewards, and its metrics."""
    roof = gymnasium.make(ID, **inputs)
    observation, _ = roof.reset(seed=7)
    roof.action_space.seed(7)
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, ended, info = roof.step(policy(roof, observation))
        total += float(reward)
        assert not terminated
    return total, info["metrics"]


def on_off(roof: Any, observation: Any) -> Any:
    return np.array([1.0 if observation[1] < roof.unwrapped.site.z_veg else 0.0])


def test_rewards_add_up_to_the_deviation() -> None:
    """On/off scores what the controller does; the sum is also right for a random policy.

    The rewards lack the first tick, whose deviation is x2* (1 - 1 / 1.3), Table II.
    """
    first = 68.8 * 0.0457 * (1 - 1 / 1.3)
    total, metrics = played(on_off, hours=2)
    assert metrics == gr.simulate("onoff", hours=2).metrics
    assert -total == pytest.approx(metrics["total_deviation_m3"] - first)
    random, of_random = played(lambda roof, _: roof.action_space.sample(), hours=2)
    assert -random == pytest.approx(of_random["total_deviation_m3"] - first)


def test_another_reward() -> None:
    """A function of what happened in the tick, and the state that it leads to."""
    total, metrics = played(
        on_off, hours=0.2, reward=lambda tick, state: -tick.flows.pump * state.site.tau
    )
    assert -total == pytest.approx(metrics["pumped_m3"])


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectorised(mode: str) -> None:
    """By Gymnasium's own means; the copies are alike, and begin again automatically."""
    roofs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, hours=0.01)
    first, _ = roofs.reset(seed=1)
    truncated = []
    for _ in range(37):
        observations, *_, ended, _ = roofs.step(np.ones((2, 1)))
        truncated.append(ended.all())
    roofs.close()
    assert (truncated.index(True), sum(truncated)) == (35, 1)
    assert (observations == first).all()


def test_observation() -> None:
    """Levels, then the forecast: 3.2 mm of rain in the three hours from 02:00."""
    roof = gymnasium.make(ID, hours=1, horizon=3)
    observation, _ = roof.reset()
    lengths = np.diff(roof.unwrapped.ends) / 3600
    assert observation[:2] == pytest.approx([3 / 1.3, 0.0457 / 1.3])
    rain, dry = np.split(observation[2:], 2)
    assert rain @ lengths == pytest.approx(3.2)
    assert dry @ lengths == pytest.approx(68.8 * (2.77537901 + 3.44779366 + 1.22675507) / 24 / 1000)


def test_seeds_draw_the_errors_of_forecasts() -> None:
    roof = gymnasium.make(ID, hours=1, forecast="errors", horizon=48)
    drawn = [roof.reset(seed=seed)[0].tolist() for seed in (1, 2, 1, None, None)]
    assert drawn[0] == drawn[2]
    assert len({tuple(each) for each in drawn}) == 4


def test_example() -> None:
    assert doctest.testmod(gr.gym).failed == 0
