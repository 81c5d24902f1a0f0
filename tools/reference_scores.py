"""Compute the scores of the scenarios' controllers: ``python tools/reference_scores.py [NAME...]``.

The scores are written to config/scenarios.csv, to which gr.score compares other controllers.
Computing all of them takes about ten minutes. A name of the form SCENARIO/CONTROLLER stands for a
single row. With --tune, print instead which level of on/off control, with which policy of the
valve, has the lowest mean score in the years to train on.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import warnings
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
import polars

from greenroof_ros.api.scenarios import REFERENCES, Score, read_references, scenarios, weigh
from greenroof_ros.api.simulate import simulate
from greenroof_ros.base.files import replace_text
from greenroof_ros.controllers.registry import find_controller
from greenroof_ros.simulation.inputs import make_inputs
from greenroof_ros.simulation.season import Case, simulate_season

A_WEEK_LATE = "a week late"
# Levels of on/off control to choose from (share of the target).
LEVELS = np.linspace(0.7, 1.0, 31).round(2).tolist()


def delay_by_a_week(archive: Path, late: Path) -> None:
    """Write a copy of archived forecasts in which all times are a week later."""
    head, *rows = archive.read_text(encoding="utf-8").splitlines()
    lines = [head]
    for row in rows:
        time, _, values = row.partition(",")
        lines.append(f"{datetime.fromisoformat(time) + timedelta(days=7):%Y-%m-%dT%H:%M},{values}")
    late.write_text("\n".join([*lines, ""]), encoding="utf-8")


def compute(scenario: str, controller: str) -> Score:
    """Return the score of one of a scenario's controllers."""
    known = scenarios[scenario]
    inputs = {**known.controllers[controller]}
    name = inputs.pop("controller")
    # The scenario's other options only apply to its own kind of forecast.
    own = {**dict.fromkeys(key for key in known.inputs if key.startswith("forecast_"))}
    if "forecast" in inputs and inputs["forecast"] != known.inputs.get("forecast"):
        inputs = {**own, **inputs}
    with tempfile.TemporaryDirectory() as directory:
        if inputs.get("forecast") == A_WEEK_LATE:
            inputs["forecast"] = str(Path(directory) / "late.csv")
            delay_by_a_week(Path(known.inputs["forecast"]), Path(inputs["forecast"]))
        return Score(known, [simulate(name, **{**known.inputs, **inputs})])


def tune(name: str) -> None:
    """Print the mean scores of on/off control at each level in the years to train on, best first.

    All levels share a run of each year, as the sites of a study do.
    """
    known, means = scenarios[name], dict[tuple[Any, ...], float]()
    policies = ["drain", "plan"] if "mains_m3" in known.weights else [None]
    starts, _ = known.training_starts(known.run["hours"])
    for policy in policies:
        scores = []
        for start in starts:
            run = make_inputs(find_controller("onoff"), {
                **known.training_inputs, "start": start, "outlet": policy, "forecast_seed":
                known.run.get("forecast_seed"),
            }).build()
            cases = [
                Case(run.site, {**run.parameters, "level": level}, run, run.x1, run.x2)
                for level in LEVELS
            ]
            results, _ = simulate_season(cases)
            scores.append([weigh(known.weights, each.metrics) for each, _ in results])
        means |= zip(
            itertools.product([policy], LEVELS), np.mean(scores, axis=0).tolist(), strict=True
        )
    for rule in sorted(means, key=lambda rule: means[rule])[:5]:
        print(f"{name}: {rule}: {means[rule]:.4f}", flush=True)


def main() -> None:
    """Write the scores of the scenarios named on the command line, or of all scenarios."""
    if sys.argv[1:2] == ["--tune"]:
        for name in sys.argv[2:]:
            tune(name)
        return
    wanted = sys.argv[1:] or [*scenarios]
    rows = [
        row for row in read_references().rows(named=True)
        if not {row["scenario"], f"{row['scenario']}/{row['controller']}"}.intersection(wanted)
    ]
    for name, known in scenarios.items():
        for controller in known.controllers:
            if not {name, f"{name}/{controller}"}.intersection(wanted):
                continue
            found = compute(name, controller)
            print(f"{name}, {controller}: {found.value:.3f}, at best {found.bound:.3f}", flush=True)
            rows.append({
                "scenario": name, "controller": controller, "score": found.value,
                "bound": found.bound, "stress_hours": found.result.metrics["stress_hours"],
            })
    order = [(name, own) for name, known in scenarios.items() for own in known.controllers]
    rows.sort(key=lambda row: order.index((row["scenario"], row["controller"])))
    text = polars.DataFrame([
        {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
        for row in rows
    ]).write_csv()
    replace_text(REFERENCES, f"# Written by python tools/reference_scores.py\n{text}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
