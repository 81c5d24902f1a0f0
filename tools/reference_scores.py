"""Compute the scores of the scenarios' controllers: ``python tools/reference_scores.py [NAME...]``.

The scores are written to config/scenarios.csv, to which gr.score compares other controllers.
Computing all of them takes about ten minutes.
"""

from __future__ import annotations

import sys
import tempfile
import warnings
from datetime import datetime, timedelta
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import polars

from greenroof_ros.api.scenarios import REFERENCES, Score, read_references, scenarios
from greenroof_ros.api.simulate import simulate
from greenroof_ros.base.files import replace_text

A_WEEK_LATE = "a week late"


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


def main() -> None:
    """Write the scores of the scenarios named on the command line, or of all scenarios."""
    wanted = sys.argv[1:] or [*scenarios]
    rows = [row for row in read_references().rows(named=True) if row["scenario"] not in wanted]
    for name in wanted:
        for controller in scenarios[name].controllers:
            found = compute(name, controller)
            print(f"{name}, {controller}: {found.value:.3f}, at best {found.bound:.3f}", flush=True)
            rows.append({
                "scenario": name, "controller": controller, "score": found.value,
                "bound": found.bound, "stress_hours": found.result.metrics["stress_hours"],
            })
    rows.sort(key=lambda row: [*scenarios].index(row["scenario"]))
    text = polars.DataFrame([
        {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
        for row in rows
    ]).write_csv()
    replace_text(REFERENCES, f"# Written by python tools/reference_scores.py\n{text}")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
