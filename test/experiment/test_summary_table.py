"""The table at the end of a run: readable sentences, regardless of what the summary holds."""

from __future__ import annotations

import io

from paper import paper_run
from rich.console import Console

from greenroof_ros.experiment import summary, summary_table
from greenroof_ros.experiment.closed_loop import Simulation


def test_no_raw_data() -> None:
    """No dictionary, list or None in any row, for a run in which everything happened."""
    run = paper_run(
        "--hours", "0.1", "--forecast", "ensemble", "--roof-noise", "0.001", "--pump-min-on", "60",
        "--weight", "0.01",
    )
    simulation = Simulation(run)
    for _ in simulation.ticks():
        pass
    metrics = simulation.metrics
    result = summary.make_summary(
        run, metrics.results(), metrics.weekly_deviations(), metrics.events(), wall_s=1.0,
        solver={"mean_s": 1e-5, "p99_s": 1e-5, "max_s": 1e-5, "solves": 9, "fallbacks": 1},
        messages={"/pump/flow": 361, "/clock": 361},
        refused={"/pump/flow": 37, "/roof/level": 2},
        parameter_changes=[
            {"tick": 300, "parameter": "weight", "before": 0.001, "value": 0.01},
            {"tick": 301, "parameter": "most", "before": None, "value": 2.0},
        ],
        parameter_change_count=5,
    )
    result |= {
        "excess_starts": 2, "limited_steps": 0, "frost_hours": 2.0,
        "weather_notes": ["rain was moved an hour back"],
        "filled": {"dew point": ["2021-07-20T13:00-05:00", "2021-07-20T14:00-05:00"]},
        "suspicious": ["79.2 mm at 2015-12-29T02:00-05:00"],
        "forecast_repeats_last_record_from": "2021-07-31T23:00-05:00",
    }
    stream = io.StringIO()
    Console(file=stream, width=200).print(summary_table.grid("Result", summary_table.rows(result)))
    text = stream.getvalue()
    assert not set("{}[]'").intersection(text) and "None" not in text
    rows = [" ".join(line.replace("│", " ").split()) for line in text.splitlines()]
    # In capitals above its limit, and left out if it is 0 as it should be.
    assert any(row.startswith("TOO MANY STARTS 2 pump starts beyond ") for row in rows)
    assert not any(row.lower().startswith("limited ticks") for row in rows)
    assert "REFUSED 39 values: 37 on /pump/flow, 2 on /roof/level" in rows
    assert "CHANGED most no limit -> 2 at 00:05 (tick 301)" in rows
