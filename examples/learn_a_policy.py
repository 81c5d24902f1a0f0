"""Example of a policy that is learned: cross-entropy search in the years to train on.

python examples/learn_a_policy.py
"""

from __future__ import annotations

import gymnasium
import numpy as np

import greenroof_ros as gr

SCENARIO, TICKS = "season-valve", 3  # in training, a decision in every quarter of an hour
NAMES = "level of the roof", "level of the cistern", "levels less per mm of rain"


class Rule:
    """Fill the roof to a level, and drain the cistern to a level that forecast rain lowers."""

    def __init__(self, numbers, ends):
        self.numbers, self.millimetres = np.atleast_2d(numbers).T, 50 / 3600 * np.diff(ends)

    def predict(self, observations):
        """Return an action, or those of many rules, for observations as shares of their ranges."""
        cistern, roof, *steps, wet = observations.T
        rain = self.millimetres @ steps[: len(self.millimetres)]  # mm in the next 24 hours
        level, keep, less = self.numbers
        pump, drain = 2 * roof < level, (wet == 0) & (1.5 * cistern > keep - less * rain)
        return np.stack([pump, drain], axis=-1).astype(np.float32).squeeze()


def learn(rounds=9, candidates=16, best=5, episodes=3, days=90):
    """Return a rule, from the best of each round's candidates in episodes of random years."""
    roofs = gymnasium.make_vec(
        "greenroof_ros.gym:GreenRoofVector-v1", num_envs=candidates * episodes, scenario=SCENARIO,
        start="random", hours=24 * days, decision_ticks=TICKS,
    )
    chance, mean, spread = np.random.default_rng(1), np.array([0.9, 0.5, 0.03]), 0.3
    for number in range(rounds):
        tried = mean * (1 + spread * chance.standard_normal((candidates, len(mean))))
        rules = Rule(tried.repeat(episodes, axis=0), roofs.ends)
        seeds = range(number * episodes, (number + 1) * episodes)  # the same days for all
        observations, _ = roofs.reset(seed=[*seeds] * candidates)
        costs, ended = np.zeros(candidates), False
        while not ended:
            observations, rewards, _, ends, _ = roofs.step(rules.predict(observations))
            costs, ended = costs - rewards.reshape(candidates, -1).mean(axis=1), ends.all()
        mean, spread = (mean + tried[np.argsort(costs)[:best]].mean(axis=0)) / 2, 0.85 * spread
        print(number, costs.min().round(2), dict(zip(NAMES, mean.round(3).tolist(), strict=True)))
    return Rule(mean, roofs.ends)


if __name__ == "__main__":
    print(gr.score(learn(), SCENARIO))  # which decides in every tick
