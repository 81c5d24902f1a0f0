"""Scenarios: scores, bounds, and what the packaged table says of the scenarios' controllers."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from places import CHECKOUT
from reference_scores import compute
from refusals import refusal

import greenroof_ros as gr
from greenroof_ros.api.scenarios import read_references
from greenroof_ros.simulation.bound import bound_discharge
from greenroof_ros.simulation.loop import simulate

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")
SHORT = ("paper", "storm-minutes", "dry-month")


def dry(state, forecast):
    return 1.0 if state.roof_level < state.site.z_veg else 0.0


class Shut:
    """On/off, with a valve that it never opens."""

    parameters = ()
    needs_forecast = False
    outlet = 0.0

    def __init__(self, site):
        self.site = site

    def command(self, cistern_level, roof_level, precipitation, evapotranspiration):
        return float(roof_level < self.site.z_veg and cistern_level >= self.site.suction_level)

    def skip(self):
        pass

    def statistics(self):
        return None


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
    ("paper", "mpc"),
    ("july-2021", "on/off"),
    ("dry-month", "drain"),
    ("storm-minutes", "plan"),
    ("season-valve", "drain"),
    ("season-forecasts", "valve closed"),
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


def wet_ticks(rain, tau, wet_after):
    """Return whether the weather is wet in each tick, by the rule as the documents state it.

    Rain counts at 0.1 mm/h, or within an hour after rain that counted; it is wet until some time
    later. No scenario begins in wet weather.

    Args:
        rain: rain rate in each tick (mm/h).
        tau: duration of a tick (s).
        wet_after: time after rain that counts as wet weather (s).
    """
    wet, end = np.zeros(len(rain), bool), -np.inf
    for k, rate in enumerate(rain):
        if rate > 0.0999999 or (rate > 0 and k * tau - end < 3599.9):
            end = (k + 1) * tau
        wet[k] = k * tau - end < wet_after - 0.1
    return wet


@pytest.mark.parametrize("scenario", SHORT)
def test_own_controllers_are_scored_and_stay_above_the_bound(scenario):
    """A function, a class: the score follows from the trajectory, added up here."""
    known = gr.scenarios[scenario]
    found = [gr.score(dry, scenario), gr.score("onoff", scenario)]
    if "wet_discharge_m3" in known.weights:
        found.append(gr.score(Shut, scenario))
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
            wet = wet_ticks(3.6e6 * ticks.precipitation[:-1], site.tau, 3600 * site.wet_after)
            own = flow[wet].sum() + 0.3 * metrics["mains_m3"] + 0.01 * metrics["stress_hours"]
        assert one.value == pytest.approx(own, rel=1e-6)


def test_a_printed_score_says_it_in_its_first_line_and_compares():
    found = gr.score(dry, "storm-minutes", outlet="plan")
    first, _, *rows = repr(found).splitlines()
    assert first.startswith(f"storm-minutes: {found.value:.2f} m3, at best {found.bound:.2f}.")
    names = [row.split("h  ", 1)[1] for row in rows]
    assert sorted(names) == sorted([
        "yours: dry, outlet=plan", *gr.scenarios["storm-minutes"].controllers
    ])
    scores = found.table["score"].to_list()
    assert scores == sorted(scores)
    assert found.table.columns == ["controller", "score", "bound", "stress_hours"]


@pytest.mark.parametrize(("given", "reason"), [
    (("onoff", "papers"), "paper"),
    (("onof", "paper"), "onoff"),
    (("onoff", None), "scenario: must be one of paper, july-2021"),
    (("onoff", gr.scenarios["paper"]), "must be one of paper, july-2021"),
    ((None, "paper"), "must be a name, a class"),
])
def test_what_cannot_be_scored_is_refused(given, reason):
    assert reason in refusal(gr.score, *given)


def test_what_the_scenario_fixes_cannot_be_given():
    for name, value in (("hours", 1), ("site", "x.yaml"), ("forecast", "perfect")):
        with pytest.raises(Exception, match=f"{name} = .*: is fixed by the scenario"):
            gr.score("onoff", "paper", **{name: value})


def test_all_data_are_in_the_package_and_name_their_licence():
    config = CHECKOUT / "config"
    size = 0
    for known in gr.scenarios.values():
        file = Path(known.inputs["weather"])
        assert file.is_relative_to(config)
        head = "".join(line for line in file.read_text().splitlines()[:8] if line[0] == "#")
        assert any(text in head for text in ("Open Government Licence", "CC BY 4.0", "MIT"))
        size += file.stat().st_size
    archive = Path(gr.scenarios["season-forecasts"].inputs["forecast"])
    assert "CC BY 4.0" in (config / "scenarios.yaml").read_text()
    assert archive.stat().st_size < 250_000 and size < 1_000_000
