"""GreenRoofVector-v1: each of its environments is a GreenRoof-v1, bit for bit."""

from __future__ import annotations

from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np
import polars
import pytest
from commanded_sites import FIELD_CAPACITY, FIRST, IMPERFECT, VALVE_SITE, WHOLE_SITE, weather
from places import CONFIG
from refusals import refusal

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")

ID = "greenroof_ros.gym:GreenRoofVector-v1"
MINUTES = gr.read_site(tau=60.0, M=1)
RANDOM = {"start": "random", "hours": 9, "decision_ticks": 47, "horizon": 6}

CASES: dict[str, dict[str, Any]] = {
    "the paper's site": {"hours": 0.02, "decision_ticks": 7},
    "one tick": {"hours": 1 / 3600, "horizon": 0.1},
    "valve, frost, quiet hours": {"site": VALVE_SITE, "weather": weather(), **RANDOM},
    "whole openings": {"site": WHOLE_SITE, "weather": weather(), **RANDOM},
    "not at a full minute": {
        "site": VALVE_SITE, "weather": weather(), **RANDOM, "start": "2021-03-13T19:20:30-04:00",
        "hours": 17,
    },
    "sensor and pump": {"site": FIELD_CAPACITY, "weather": weather(), **RANDOM, **IMPERFECT},
    "end of the record": {
        "site": MINUTES, "weather": weather(), **RANDOM, "start": "2021-03-15T19:00Z",
        "horizon": 240,
    },
    "rain in five minutes": {"site": MINUTES, "weather": weather(5), **RANDOM},
    "ticks of four minutes": {
        "site": gr.read_site(tau=240.0, M=1), "weather": weather(5), **RANDOM,
    },
    "ticks of seven seconds": {
        "site": gr.read_site(tau=7.0, M=3), "weather": weather(), **RANDOM, "hours": 0.7,
    },
    "errors": {"site": MINUTES, "weather": weather(), **RANDOM, "forecast": "errors"},
    "ensemble": {"site": MINUTES, "weather": weather(), **RANDOM, "forecast": "ensemble"},
    "archive": {
        "site": MINUTES, "hours": 9, "decision_ticks": 47,
        "forecast": str(CONFIG / "forecasts" / "rain_that_never_comes.csv"),
    },
}


def flatten(infos: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested infos by their paths, as lists with their types."""
    flat = {}
    for name, value in infos.items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{name}/")
        else:
            flat[prefix + name] = value.dtype, value.tolist()
    return flat


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("case", CASES)
def test_each_environment_is_a_single_one(case: str, way: None) -> None:
    """Those of Gymnasium's own vector environment, over two ends of episodes."""
    inputs, count = CASES[case], 4
    ours = gymnasium.make_vec(ID, num_envs=count, **inputs)
    theirs = gymnasium.make_vec(
        "greenroof_ros.gym:GreenRoof-v1", num_envs=count, vectorization_mode="sync", **inputs
    )
    for name in ("observation_space", "single_observation_space", "action_space",
                 "single_action_space"):
        assert getattr(ours, name) == getattr(theirs, name)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    results = [each.reset(seed=5) for each in (ours, theirs)]
    theirs.action_space.seed(6)
    ends = 0
    while ends < 2:
        (seen, *rest, infos), (expected, *others, known) = results
        assert seen.dtype == expected.dtype and seen.tobytes() == expected.tobytes()
        for array, other in zip(rest, others, strict=True):
            assert array.dtype == other.dtype and array.tolist() == other.tolist()
        assert flatten(infos) == flatten(known)
        ends += bool(rest) and rest[-1].all()
        actions = theirs.action_space.sample()
        results = [each.step(actions) for each in (ours, theirs)]


def test_threads_share_many_environments() -> None:
    """A hundred and fifty, of which those at the ends of the threads' parts are compared."""
    inputs = {"site": VALVE_SITE, "weather": weather(), **RANDOM}
    roofs = gymnasium.make_vec(ID, num_envs=150, **inputs)
    observations, infos = roofs.reset(seed=[*range(150)])
    actions = np.random.default_rng(1).random((150, 2))
    for _ in range(12):
        after, rewards, *_, last = roofs.step(actions)
    for row in (0, 74, 75, 149):
        roof = gymnasium.make("greenroof_ros.gym:GreenRoof-v1", **inputs)
        first, info = roof.reset(seed=row)
        assert first.tobytes() == observations[row].tobytes()
        assert info["start"] == infos["start"][row]
        for _ in range(12):
            expected, reward, _, _, ended = roof.step(actions[row])
        assert expected.tobytes() == after[row].tobytes() and reward == rewards[row]
        for name, value in ended["metrics"].items():
            assert last["metrics"][name][row] == value, name
    roofs.close()


def test_seeds_and_options() -> None:
    """As of a single environment: a seed for each, options for all, and then the own start."""
    inputs = {"site": MINUTES, "weather": weather(), "hours": 2, "start": "2021-03-13T00:00Z"}
    roofs = gymnasium.make_vec(ID, num_envs=3, **{**inputs, "start": "random"})
    _, drawn = roofs.reset(seed=7)
    assert roofs.reset(seed=[9, 8, 7])[1]["start"][2] == drawn["start"][0]
    assert len({*drawn["start"]}) == 3
    roofs = gymnasium.make_vec(ID, num_envs=3, **inputs)
    _, drawn = roofs.reset(options={"start": "2021-03-14T00:00Z", "initial": "high-high"})
    assert drawn["cistern_m3"].tolist() == pytest.approx([1.3 * 75] * 3)  # Table II
    assert {*drawn["start"]} == {"2021-03-14T00:00:00+00:00"}
    assert {*roofs.reset()[1]["start"]} == {"2021-03-13T00:00:00+00:00"}
    with pytest.raises(ValueError, match="argument 2 is longer"):
        roofs.reset(seed=[1, 2])


def test_random_starts_lack_no_hour() -> None:
    """All hours are drawn from which an episode of 9 h and a tick could be simulated, no other."""
    frame = weather().with_columns(
        polars.when(polars.int_range(polars.len()).is_between(*missing)).then(None)
        .otherwise(polars.col(name)).alias(name) for name, missing in {
            "precipitation [mm/h]": (20, 21), "temperature [degC]": (50, 60),
        }.items()
    )
    inputs = {**RANDOM, "site": MINUTES, "weather": frame}
    roofs = gymnasium.make_vec(ID, num_envs=800, **inputs)
    drawn = {*roofs.reset(seed=1)[1]["start"]}
    del inputs["decision_ticks"]
    possible = set()
    for hour in range(96 - 9):
        start = (FIRST + timedelta(hours=hour)).isoformat()
        with suppress(ConfigurationError):
            possible.add(gr.Environment(**{**inputs, "start": start}).state.time.isoformat())
    assert drawn == possible and 20 < len(possible) < 70


def test_a_reward_of_ones_own() -> None:
    """Every environment has that of a single one."""
    inputs = {"site": VALVE_SITE, "weather": weather(), **RANDOM}
    inputs["reward"] = lambda tick, state: tick.flows.pump + state.roof * tick.outlet
    roofs = gymnasium.make_vec(ID, num_envs=3, **inputs)
    roofs.reset(seed=4)
    actions = np.random.default_rng(2).random((3, 2))
    rewards = [roofs.step(actions)[1] for _ in range(2)]
    for row in range(3):
        roof = gymnasium.make("greenroof_ros.gym:GreenRoof-v1", **inputs)
        roof.reset(seed=4 + row)
        assert [roof.step(actions[row])[1] for _ in range(2)] == [each[row] for each in rewards]


@pytest.mark.parametrize("actions", [
    np.full((3, 2), 0.5), np.full(3, 0.5), [[0.5], [0.5], [1.1]], [[0.5], [np.nan], [0.0]],
])
def test_refused_actions(actions: Any) -> None:
    roofs = gymnasium.make_vec(ID, num_envs=3, hours=1)
    roofs.reset(seed=1)
    refusal(roofs.step, np.array(actions), match=r"action: .*of shape \(3, 1\)")
