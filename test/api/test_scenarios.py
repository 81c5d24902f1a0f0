"""Scenarios: scores, bounds, and what the packaged table says of the scenarios' controllers."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from paper import find_wet
from places import CHECKOUT, refusal
from reference_scores import compute

import greenroof_ros as gr
from greenroof_ros.api.scenarios import read_references
from greenroof_ros.simulation.bound import bound_discharge
from greenroof_ros.simulation.loop import simulate

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
SHORT = ("paper", "storm-minutes", "dry-month")


def dry(state, forecast):
    return 1.0 if state.roof_level < state.site.z_veg else 0.0


def shut(state, forecast):
    """On/off, with a valve that it never opens."""
    return dry(state, forecast), 0.0


def reference(scenario: str, controller: str) -> dict[str, float]:
    own = read_references().filter(scenario=scenario, controller=controller)
    return own.row(0, named=True)


def test_the_table_has_each_controller_of_each_scenario_and_none_is_below_its_bound():
    rows = read_references().rows(named=True)
    expected = [
        (name, controller)
        for name, known in gr.scenarios.items() for controller in known.controllers
    ]
    assert [(row["scenario"], row["controller"]) for row in rows] == expected
    assert [*gr.scenarios] == [
        "paper", "july-2021", "season-forecasts", "season-valve", "dry-month", "storm-minutes",
    ]
    for row in rows:
        assert 0 < row["bound"] <= row["score"]
    for known in gr.scenarios.values():  # a placebo in each, which is never the only best
        scores = {row["controller"]: row["score"] for row in rows if row["scenario"] == known.name}
        placebos = [score for name, score in scores.items() if name.startswith("placebo")]
        assert len(placebos) == 1 and placebos[0] >= min(scores.values())


def test_the_inputs_of_a_scenario_are_new_each_time():
    paper = gr.scenarios["paper"]
    with pytest.raises(AttributeError):
        paper.inputs = {}
    paper.inputs["hours"] = 1
    assert paper.inputs["hours"] == 12
    assert gr.simulate("onoff", **{**paper.inputs, "hours": 1}).run.steps == 3600


@pytest.mark.parametrize(("scenario", "controller"), [
    ("paper", "mpc"), ("july-2021", "on/off"), ("dry-month", "drain"), ("storm-minutes", "plan"),
    ("season-valve", "drain"), ("season-forecasts", "valve closed"),
])
def test_the_table_is_what_its_command_computes(scenario, controller):
    found, row = compute(scenario, controller), reference(scenario, controller)
    assert found.value == pytest.approx(row["score"], rel=1e-5)
    assert found.bound == pytest.approx(row["bound"], rel=1e-5)


def test_the_papers_deviation_is_that_of_the_authors_code():
    """Their MATLAB code, low-low, on/off at 1: a sum over 43,201 ticks."""
    with (CHECKOUT / "config/paper/totals.csv").open() as stream:
        (total,) = (
            float(row["total_deviation_m3"]) for row in csv.DictReader(stream)
            if (row["initial"], row["controller"], float(row["parameter"])) == (
                "low-low", "onoff", 1
            )
        )
    found = gr.score("onoff", "paper")
    assert found.value == pytest.approx(1000 * total / 43201 / 68.8, rel=1e-4)
    # doc/explanation/bound.md: what greenroof bound prints for this run.
    assert found.bound == pytest.approx(1000 * 4421.98 / 43201 / 68.8, rel=1e-5)


@pytest.mark.parametrize("scenario", SHORT)
def test_own_controllers_are_scored_and_stay_above_the_bound(scenario):
    """The score follows from the trajectory, added up here."""
    known = gr.scenarios[scenario]
    found = [gr.score(dry, scenario), gr.score("onoff", scenario)]
    if "wet_discharge_m3" in known.weights:
        found.append(gr.score(shut, scenario))
        closed = reference(scenario, "valve closed")["score"]
        assert found[2].value == pytest.approx(closed, rel=1e-5)
    assert found[0].value == found[1].value  # the suction level does not matter here
    if known.unit == "m3":  # the whole frontier of a run of its own
        run = found[1].result.run
        (point,) = bound_discharge(run, simulate(run, every=1)[1], [0.3])
        assert found[1].bound == pytest.approx(point.wet_discharge_m3 + 0.3 * point.mains_m3)
    for one in found:
        assert one.bound <= one.value
        ticks, site = one.result.ticks, one.result.run.site
        if known.unit == "mm":
            own = 1000 * np.abs(ticks.roof - site.x2_star).mean() / site.a2
        else:
            flow, metrics = site.tau * (ticks.outflow + ticks.drainage)[:-1], one.result.metrics
            wet = find_wet(3.6e6 * ticks.precipitation[:-1], site.tau, site.wet_after)
            own = flow[wet].sum() + 0.3 * metrics["mains_m3"] + 0.01 * metrics["stress_hours"]
        assert one.value == pytest.approx(own, rel=1e-6)


@pytest.mark.parametrize(("given", "reason"), [
    (("onoff", "papers"), "paper"), (("onoff", None), "scenario: must be one of paper, july-2021"),
    ((None, "paper"), "must be a name, a class"),
])
def test_what_cannot_be_scored_is_refused(given, reason):
    assert reason in refusal(gr.score, *given)


def test_all_data_are_in_the_package_and_name_their_licence():
    config = CHECKOUT / "config"
    for known in gr.scenarios.values():
        file = Path(known.inputs["weather"])
        assert file.is_relative_to(config)
        head = "".join(line for line in file.read_text().splitlines()[:8] if line[0] == "#")
        assert any(text in head for text in ("Open Government Licence", "CC BY 4.0", "MIT"))
    assert "CC BY 4.0" in (config / "scenarios.yaml").read_text()
