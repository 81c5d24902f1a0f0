"""The table at the end of a run: readable sentences, regardless of what the summary holds."""

from __future__ import annotations

import io

from paper import paper_run
from rich.console import Console

from greenroof_ros.simulation import screen
from greenroof_ros.simulation.loop import simulate


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
