"""The table at the end of a run: readable sentences, regardless of what the summary holds."""

from __future__ import annotations

import io
from typing import Any

import pytest
from paper import paper_run
from rich.console import Console

from greenroof_ros.simulation import screen
from greenroof_ros.simulation.loop import simulate


@pytest.mark.parametrize(("changed", "shown"), [
    ({}, False), ({"rain_cistern_m3": 0.5, "rain_roof_m3": 5.0}, True),
    ({"rain_cistern_m3": 0.4, "rain_roof_m3": 5.0}, False),
    ({"rain_cistern_m3": 0.0, "rain_roof_m3": 0.0}, False),
    ({"rain_cistern_m3": 0.0, "rain_roof_m3": 0.0, "parameters": {"outlet": "drain"}}, True),
])
def test_storm_water_is_shown_where_it_is_collected(
    changed: dict[str, Any], shown: bool
) -> None:
    """By a catchment, or a valve; not in the paper's twelve hours. One peak is enough."""
    whole, _ = simulate(paper_run("--controller", "onoff", "--hours", "2"))
    rows = list(screen.rows({**whole, **changed}))
    words = {word for word, *_ in rows}
    assert {"outflow", "pumped", "retention of the roof"} <= words
    storm = {
        "discharge", "discharge in wet weather", "peak discharge, 5 min", "overflow",
        "days of overflow", "retention", "rain events",
    }
    assert words & storm == (storm if shown else set())
    assert sum("peak" in word for word in words) == shown


def test_no_raw_data() -> None:
    """No dictionary, list or None in any row, for a run in which everything happened."""
    run = paper_run(
        "--hours", "0.1", "--forecast", "ensemble", "--roof-noise", "0.001", "--pump-min-on", "60",
        "--weight", "0.01",
    )
    result = simulate(run)[0] | {
        "solver": {"mean_s": 1e-5, "p99_s": 1e-5, "max_s": 1e-5, "solves": 9, "fallbacks": 1},
        "messages": {"/pump/flow": 361, "/clock": 361},
        "refused": {"/pump/flow": 37, "/roof/level": 2},
        "parameter_changes": [
            {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.01},
            {"tick": 301, "parameter": "most", "before": None, "value": 2.0},
        ],
        "parameter_change_count": 5,
        "excess_starts": 2, "limited_steps": 0, "frost_hours": 2.0,
        "weather_notes": ["rain was moved an hour back"],
    }
    stream = io.StringIO()
    Console(file=stream, width=200).print(screen.grid("Result", screen.rows(result)))
    text = stream.getvalue()
    assert not set("{}[]'").intersection(text) and "None" not in text
    rows = [" ".join(line.replace("│", " ").split()) for line in text.splitlines()]
    # In capitals above its limit, and left out if it is 0 as it should be.
    start = "TOO MANY STARTS 2 number of pump starts in excess of "
    assert any(row.startswith(start) for row in rows)
    assert not any(row.lower().startswith("limited ticks") for row in rows)
    assert "REFUSED 39 values: 37 on /pump/flow, 2 on /roof/level" in rows
    assert "CHANGED most no limit -> 2 at 00:05 (tick 301)" in rows
