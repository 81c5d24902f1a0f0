"""The example of a policy that is learned: its rule, and a search that is short."""

from __future__ import annotations

import numpy as np
import pytest

import greenroof_ros as gr

pytest.importorskip("gymnasium", reason="gymnasium is not installed")

from examples.learn_a_policy import Rule, learn


def test_the_rule() -> None:
    """Of observations with two steps of an hour: 10 mm of rain lower the level by 0.3."""
    rule = Rule([0.9, 0.6, 0.03], [0, 3600, 7200])

    def act(cistern: float, roof: float, rain: float, wet: float) -> list[float]:
        entries = cistern / 1.5, roof / 2, rain / 50, 0.0, 0.0, 0.0, wet
        return rule.predict(np.array([entries], np.float32)).tolist()

    assert act(0.59, 0.89, 0, 0) == [1, 0] and act(0.61, 0.91, 0, 0) == [0, 1]
    assert act(0.31, 1, 10, 0) == [0, 1] and act(0.29, 1, 10, 0) == [0, 0]
    assert act(0.9, 1, 0, 0.5) == [0, 0]


def test_a_short_search_is_scored() -> None:
    rule = learn(rounds=1, candidates=3, best=1, episodes=2, days=2)
    assert gr.score(rule, "storm-minutes", decision_ticks=15).value > 0
