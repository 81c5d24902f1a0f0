"""GreenRoofVector-v1: each of its environments is a GreenRoof-v1, bit for bit."""

from __future__ import annotations

from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np
import polars
import pytest
from paper import (
    FIRST_OF_FOUR_DAYS,
    IMPERFECT,
    LIMITED_SOIL,
    LIMITED_VALVE,
    LIMITED_WHOLE,
    four_days,
)
from places import CONFIG, refusal

import greenroof_ros as gr
from greenroof_ros.base.errors import ConfigurationError

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed")

ID = "greenroof_ros.gym:GreenRoofVector-v1"
MINUTES = gr.read_site(tau=60.0, M=1)
RANDOM = {
    "weather": four_days(), "start": "random", "hours": 9, "decision_ticks": 47, "horizon": 6,
}

CASES: dict[str, dict[str, Any]] = {
    "one tick of the paper's site": {"hours": 1 / 3600, "horizon": 0.1},
    "valve, frost, quiet hours": {"site": LIMITED_VALVE, **RANDOM},
    "whole openings, not at a full minute": {
        "site": LIMITED_WHOLE, **RANDOM, "start": "2021-03-13T19:20:30-04:00", "hours": 17,
    },
    "many, in threads": {"site": LIMITED_VALVE, **RANDOM, "hours": 2},
    "sensor and pump": {"site": LIMITED_SOIL, **RANDOM, **IMPERFECT},
    "end of the record": {
        "site": MINUTES, **RANDOM, "start": "2021-03-15T19:00Z", "horizon": 240,
    },
    "rain in five minutes, ticks of four": {
        "site": gr.read_site(tau=240.0, M=1), **RANDOM, "weather": four_days(5),
    },
    "ticks of seven seconds": {"site": gr.read_site(tau=7.0, M=3), **RANDOM, "hours": 0.7},
    "a reward of one's own": {
        "site": LIMITED_VALVE, **RANDOM,
        "reward": lambda tick, state: tick.flows.pump + state.roof * tick.outlet,
    },
    "errors": {"site": MINUTES, **RANDOM, "forecast": "errors"},
    "ensemble": {"site": MINUTES, **RANDOM, "forecast": "ensemble"},
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
    inputs, count = CASES[case], 150 if "threads" in case else 4
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


def test_seeds_and_options() -> None:
    """As of a single environment: a seed for each, options for all, and then the own start."""
    inputs = {"site": MINUTES, "weather": four_days(), "hours": 2, "start": "2021-03-13T00:00Z"}
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
    frame = four_days().with_columns(
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
        start = (FIRST_OF_FOUR_DAYS + timedelta(hours=hour)).isoformat()
        with suppress(ConfigurationError):
            possible.add(gr.Environment(**{**inputs, "start": start}).state.time.isoformat())
    assert drawn == possible and 20 < len(possible) < 70


@pytest.mark.parametrize("actions", [
    np.full((3, 2), 0.5), np.full(3, 0.5), [[0.5], [0.5], [1.1]], [[0.5], [np.nan], [0.0]],
])
def test_refused_actions(actions: Any) -> None:
    roofs = gymnasium.make_vec(ID, num_envs=3, hours=1)
    roofs.reset(seed=1)
    refusal(roofs.step, np.array(actions), match=r"action: .*of shape \(3, 1\)")
