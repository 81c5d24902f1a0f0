"""Reports of studies: exact results, the data of each figure, seeds, and the command."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from inputs import (
    Simulated,
    command,
    ended_run,
    figures_of,
    page_of,
    report_of,
    seeded_rows,
    simulate,
    study_of,
    trajectory_of,
    write_study,
)
from paper import PAPER_SITE, site_file
from refusals import refusal

from greenroof_ros.analysis.report.bags import MOST_POINTS, near_hours, thin
from greenroof_ros.analysis.report.drawing import value_axis
from greenroof_ros.analysis.report.figures import is_figure, published_totals
from greenroof_ros.analysis.report.groups import SEEDS, Report
from greenroof_ros.analysis.report.tables import make_tables
from greenroof_ros.analysis.report.words import cautions, sentences
from greenroof_ros.commands.report import _former_report
from greenroof_ros.model.metrics import METRICS, NEAR_TARGET
from greenroof_ros.recording.trajectory import Trajectory

TOTAL = "total_deviation_m3"


@pytest.fixture(scope="module")
def simulated() -> list[Simulated]:
    """Two settings of each controller from two initial states."""
    return [
        simulate(controller, option, initial)
        for initial in ("low-low", "high-low")
        for controller, options in (("mpc", ("0.00001", "0.001")), ("onoff", ("0.5", "2")))
        for option in options
    ]


@pytest.fixture(scope="module")
def study(simulated: list[Simulated], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of these runs."""
    return write_study(
        tmp_path_factory.mktemp("study") / "study",
        [(example.row, example.trajectory) for example in simulated],
    )


# --- exact results -------------------------------------------------------------------------------


def test_results_are_the_tables(tmp_path: Path) -> None:
    """Not of the samples that are kept, which only show when there was frost."""
    row = {**simulate("onoff", "0.5", "low-low").row, "max_command": 2.0, "pump_starts": 31,
           "excess_starts": 11, "frost_hours": 3 / 3600}
    trajectory = trajectory_of(range(7), cistern=1, roof=1, frost=[0, 0, 1, 1, 0, 1, 1])
    report = report_of(write_study(tmp_path / "study", [(row, trajectory)]))
    (judged,), results = report.single, [name for name in row if name.endswith("_m3")]
    assert [judged[name] for name in results] == [row[name] for name in results]
    text = page_of(report)
    for words in (
        "The command was above 1", "The pumps started more than 20 times in an hour",
    ):
        assert words in text
    assert re.search(r"pump starts \(1\)</th> <td [^>]*>31<", text)
    assert report.drawn["001"].frost == [(2, 4), (5, 6)]
    assert "Grey: frost" in figures_of(report)["weather-1"].caption


def test_what_follows_from_results(tmp_path: Path) -> None:
    """By hand: storage, unexplained volume, and money; the last sample counts for a tick."""
    row = {
        **simulate("onoff", "0.5", "low-low").row, "cistern_m3": 60.0, "roof_m3": 2.0,
        "final_cistern_m3": 55.0, "final_roof_m3": 3.5, "rain_cistern_m3": 1.0, "pumped_m3": 4.0,
        "outflow_m3": 2.5, "rain_roof_m3": 0.5, "evapotranspiration_m3": 2.0, "drainage_m3": 0.75,
        "electric_energy_kwh": 2.0, "near_target_hours": 0.1, "hours": 0.2, "bound_m3": 100.0,
        TOTAL: 150.0,
    }
    (judged,) = study_of(tmp_path / "study", row, energy_price=0.2, water_price=5.0).single
    assert (judged["cistern_change_m3"], judged["roof_change_m3"]) == (-5, 1.5)
    assert judged["cistern_residual_m3"] == pytest.approx(-5 - (1 - 4 - 2.5))
    assert judged["roof_residual_m3"] == pytest.approx(1.5 - (0.5 + 4 - 2 - 0.75))
    assert (judged["energy_cost"], judged["water_value"], judged["ratio"]) == (0.4, 20, 1.5)
    assert judged["near_share"] == pytest.approx(0.1 / (0.2 + 1 / 3600))


def each_minute(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory of every second with each 60th sample, and the last."""
    last = len(trajectory.time) - 1
    kept = [*range(0, last, 60), last]
    return replace(trajectory, **{
        name: series[kept] for name, series in vars(trajectory).items() if name != "start"
    })


def test_another_band_needs_what_happened(tmp_path: Path) -> None:
    """Unknown without a trajectory, or if it has not every tick; then a note states why."""
    every_tick, row, _ = simulate("onoff", "0.5", "low-low")
    trajectories = (every_tick, each_minute(every_tick), None)
    path = write_study(tmp_path / "study", [(row, kept) for kept in trajectories])
    report = report_of(path, band=0.2)
    assert [run["near_target_hours"] for run in report.single] == [
        near_hours(PAPER_SITE, every_tick, 0.2), None, None
    ]
    text = page_of(report)
    unknown = "time near the target is unknown: only samples every 60 s were kept"
    assert "</summary>002</details>" in text.partition(unknown)[2].partition("</li>")[0]
    assert len(re.findall(r"<td [^>]*>unknown<", text)) == 4  # the time and its share, of two runs
    for usual in report_of(path, band=NEAR_TARGET).single:
        assert usual["near_target_hours"] == row["near_target_hours"]


# --- figures -------------------------------------------------------------------------------------


@given(values=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000))
def test_thinning_keeps_ends_and_extremes(values: list[float]) -> None:
    """For any line, its peaks are drawn, in order, with few points."""
    column = np.array(values)
    kept = thin(column, 100)
    assert len(kept) <= 102
    assert (np.diff(kept) > 0).all()
    assert {0, len(values) - 1} <= set(kept.tolist())
    assert column[kept].max() == column.max() and column[kept].min() == column.min()


def test_figures_of_single_runs(study: Path, simulated: list[Simulated]) -> None:
    """Weather from the file, lines from samples, totals at each setting, bars that add up."""
    figures = figures_of(report_of(study))
    weather = figures["weather-1"].data
    assert {row["v"] for row in weather["rain-1"]} == {0.0}
    rows = weather["evapotranspiration-1"]
    assert {row["method"] for row in rows} == {"published"}
    assert [row["v"] for row in rows] == pytest.approx([2.77537901] * len(rows), rel=1e-6)
    # Local time as if it were UTC, so the axis is the same in every reader's browser.
    assert rows[0]["t"] == datetime.fromisoformat("2021-07-07T02:00+00:00").timestamp() * 1000

    lines = figures["trajectories-1-1"]
    assert len(lines.panels) == 8 and lines.columns == 2
    for example in simulated[:4]:
        name = example.row["controller"]
        label = example.row[f"parameter:{'weight' if name == 'mpc' else 'fraction'}"]
        for quantity in ("command", "pump_flow", "cistern", "roof"):
            rows = [
                row for row in lines.data[f"{quantity}-1-1-{name}"] if row["setting"] == label
            ]
            values = getattr(example.trajectory, quantity)
            if quantity in ("command", "pump_flow"):
                values = np.append(values[:-1], values[-2])  # the last is not applied, nor drawn
            if quantity == "pump_flow":
                values = 1000 * values  # in L/s
            assert 100 < len(rows) <= MOST_POINTS
            ticks = [round((row["t"] - weather["rain-1"][0]["t"]) / 1000) for row in rows]
            assert [row["v"] for row in rows] == pytest.approx(values[ticks], rel=1e-6, abs=1e-12)
            assert max(row["v"] for row in rows) == pytest.approx(values.max(), rel=1e-6)

    panels = figures["total-deviation-1"].panels
    assert [panel.title for panel in panels] == ["from low-low", "from high-low"]
    totals = {
        row["run"]: row["v"]
        for drawn in figures["total-deviation-1"].data.values() for row in drawn
    }
    assert totals == pytest.approx({
        f"{number:03}": example.row[TOTAL] for number, example in enumerate(simulated, start=1)
    }, rel=1e-6)
    # Deviation is the paper's fifth figure, after schematic, two of the pump, and weather.
    assert "(Fig. 5)" in METRICS[0].meaning

    for tank in ("cistern", "roof"):
        sums: dict[str, float] = {}
        for initial in (1, 2):
            for row in figures["water-balance-1"].data[f"balance-1-{tank}-{initial}"]:
                run = f"{row['run']} {initial}"
                sums[run] = sums.get(run, 0) + row["v"]
        changes = [np.ptp(getattr(example.trajectory, tank)[[0, -1]]) for example in simulated]
        assert sorted(map(abs, sums.values())) == pytest.approx(sorted(changes), abs=1e-5)


PAPERS_TOTALS = {"001": 9725.43, "002": 9635.5272}  # fractions 0.2 and 0.5


@pytest.mark.parametrize(("columns", "site", "published"), [
    ({}, {"latitude": 45.5}, PAPERS_TOTALS),
    ({}, {"quiet_hours": ["01:00-02:00"], "time_zone": "America/Toronto"}, {}),
    ({"hours": "11"}, {}, {}),
    ({"evapotranspiration": "fao56"}, {}, {}),
    ({"roof_offset": "0.005"}, {}, {}),
    ({"forecast": "persistence"}, {}, {}),
    ({"start": "2021-07-07T02:00-04:00"}, {}, {}),
])
def test_published_totals_stand_next_to_the_papers_own_runs(
    tmp_path: Path, columns: dict[str, str], site: dict[str, Any], published: dict[str, float]
) -> None:
    """Only for 12 h from its start, with its evapotranspiration, and on its site.

    The site may be elsewhere, since the weather is given; nothing that Table I lacks is added.
    """
    row = {**simulate("onoff", "0.5", "low-low").row, "hours": 12.0, **columns}
    study = write_study(tmp_path / "study", [
        ({**row, "parameter:fraction": fraction}, None) for fraction in ("0.2", "0.5")
    ])
    site_file(study / "configuration", **site)
    report = report_of(study)
    assert published_totals(report, report.single) == published
    caption = figures_of(report)["total-deviation-1"].caption
    assert ("Hollow: the authors' code" in caption) == bool(published)


def test_any_controller_with_any_parameters(tmp_path: Path) -> None:
    """Controllers and parameters that this package does not know, with numbers and words."""
    example = simulate("mpc", "0.001", "low-low")
    few = each_minute(example.trajectory)
    report = report_of(write_study(tmp_path / "study", [
        ({**example.row, "parameter:weight": "", "controller": name,
          **{f"parameter:{key}": text for key, text in given.items()}}, few)
        for name, given in (
            ("lookahead", {"horizon": "60", "forecast": "hourly"}),
            ("lookahead", {"horizon": "9", "forecast": "perfect"}),
            ("anticipating_onoff", {"threshold": "0.5"}),
            ("anticipating_onoff", {"threshold": "inf"}),
            ("proportional", {}),
            ("proportional", {}),
        )
    ]))
    assert {name: settings.labels for name, settings in report.settings.items()} == {
        "lookahead": ["horizon 9, forecast perfect", "horizon 60, forecast hourly"],
        "anticipating_onoff": ["0.5", "none"], "proportional": ["none"],
    }
    # Nothing but their names distinguishes two runs of the same place without parameters.
    assert [row["setting"] for row in report.single[2:]] == [
        "threshold 0.5", "threshold none", "005", "006"
    ]
    assert "trajectories-1-1" in figures_of(report)
    assert [row["setting"] for row in report.best()] == [""] * 3  # their totals are equal


def test_a_controller_without_parameters(tmp_path: Path) -> None:
    """It has no settings, regardless of the number of its runs, and is called by its name alone."""
    example = simulate("mpc", "0.001", "low-low")
    report = study_of(tmp_path / "study", *(
        {**example.row, "parameter:weight": "", "controller": "mine",
         "start": f"2021-07-0{day}T02:00:00-05:00"} for day in (1, 2, 3)
    ))
    first, second, _ = sentences(report)
    assert first == "3 runs of mine, from low-low: 3 sets of conditions."
    assert second.count("(mine)") == 3
    assert [row["setting"] for row in report.best()] == [""] * 3
    drawn = figures_of(report)["water-balance-1"].data["balance-1-roof-1"]
    assert {row["run"] for row in drawn} == {"mine"}


def test_the_minimum_possible(tmp_path: Path, simulated: list[Simulated]) -> None:
    """A line for each initial state in the figure, and a column in the tables."""
    bounds = {"low-low": 200.0, "high-low": 100.0}
    rows = [
        {**example.row, "bound_m3": bounds[example.row["initial"]]} for example in simulated
    ]
    rows[1]["bound_m3"] = ""  # unknown
    report = study_of(tmp_path / "study", *rows)
    figures = figures_of(report)
    # Without trajectories there are the figures of results.
    assert list(figures) == [
        "total-deviation-1", "time-in-band-1", "energy-1", "pump-starts-1", "water-balance-1",
    ]
    for panel, bound in zip(figures["total-deviation-1"].panels, (200.0, 100.0), strict=True):
        assert [{"v": bound}] in panel.specification()["datasets"].values()
    text = page_of(report)
    assert "No trajectory was kept" in text
    assert text.count("over the minimum possible (1)</button>") == 2
    assert f">{simulated[0].row[TOTAL] / 200:.4f}<" in text
    assert ">unknown<" in text


def test_both_methods_stand_side_by_side(tmp_path: Path) -> None:
    """With their difference in %, by hand: 3 % more."""
    trajectory, row, _ = simulate("mpc", "0.001", "low-low")
    more = {**row, "evapotranspiration": "fao56", TOTAL: 1.03 * row[TOTAL]}
    few = each_minute(trajectory)
    report = report_of(write_study(tmp_path / "study", [(row, few), (more, few)]))
    assert [window["evapotranspiration"] for window in report.windows()] == ["published", "fao56"]
    (table,) = [table for table in make_tables(report) if "both kinds" in table.name]
    assert [cell.text for cell in table.rows[0]][2:] == [
        f"{row[TOTAL]:.2f}", f"{1.03 * row[TOTAL]:.2f}", "+3.00"
    ]
    assert {row["method"] for row in figures_of(report)["weather-1"].data["evapotranspiration-1"]
            } == {"published", "fao56"}


@pytest.mark.parametrize(("values", "kind", "domain"), [
    ([7152, 9582, 9599, 9780], None, (6942, 9990)),  # about the values, not from 0
    ([9.0, 10.0, 0.5], None, (0, 10.76)),  # not below 0
    ([49929.66] * 3, None, (45935, 53925)),  # no height of 0
    ([0, 0, 0], None, (0, 1)),
    ([7152, 9582, 9599, 500_000], "log", (6502, 550_000)),
    ([0, 1, 2, 500], "symlog", (0, 750)),  # starts of a pump
])
def test_a_large_value_flattens_no_panel(
    values: list[float], kind: str | None, domain: tuple[float, float]
) -> None:
    """Linear, unless half of the values would share a tenth of the axis."""
    scale = value_axis(values)["scale"].to_dict()
    assert scale.get("type") == kind
    assert scale["domain"] == pytest.approx(domain, rel=1e-3)


# --- many seeds ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """A study of forecast errors: a table without trajectories."""
    rows = seeded_rows(simulate("onoff", "0.5", "low-low").row)
    return study_of(tmp_path_factory.mktemp("seeds") / "study", *rows)


def test_seeds_belong_together(seeds: Report) -> None:
    """A case of 25 seeds: their mean, mean of the worst two and a half, and worst, by hand."""
    (table,) = make_tables(seeds)
    cells = [[cell.text for cell in row] for row in table.rows]
    assert cells[2] == [
        "on/off fraction 0.5", "low-low", "2021-07-07 02:00-05:00, 12 h", "25", "better",
        "1013.00", "1024.20", "1025.00", "2.0260", "2.0484", "2.0500",
    ]
    # Controllers, then settings, then skills, each from the best or smallest.
    assert [(row[0], row[4]) for row in cells[:6]] == [
        (name, skill) for name in ("MPC weight 0.01", "on/off fraction 0.5", "on/off fraction 2")
        for skill in ("better", "real")
    ]
    assert len(cells) == 24
    text = page_of(seeds)
    # 25 different numbers of ticks give one note.
    assert text.count("found no solution in some ticks") == 1

    figures = figures_of(seeds)
    assert list(figures) == ["forecast-errors"]
    figure = figures["forecast-errors"]
    assert figure.panels[1].title == ["2021-07-07 02:00-05:00, 12 h", "from high-low"]
    assert {
        row["amount"]: row["v"] for row in figure.data["forecast-errors-2"]
        if row["series"] == "on/off fraction 0.5" and row["skill"] == "better"
    } == {"mean": 1013, "mean of the worst tenth": 1024.2}
    colour = figure.panels[0].specification()["layer"][-1]["encoding"]["color"]["scale"]
    # The colour depends on the controller, not on its setting.
    assert colour["domain"] == ["MPC weight 0.01", "on/off fraction 0.5", "on/off fraction 2"]
    assert colour["range"][0] != colour["range"][1] == colour["range"][2]


def test_seeds_next_to_other_runs(tmp_path: Path) -> None:
    """A perfect forecast and a single seed are shown as before, complete in their tables."""
    example = simulate("mpc", "0.001", "low-low")
    few = each_minute(example.trajectory)
    errors = {**example.row, "forecast": "errors", "forecast_skill": "real"}
    report = report_of(write_study(tmp_path / "study", [
        (example.row, few),
        ({**errors, "forecast_skill": "worse", "forecast_seed": "7"}, few),
        *(({**errors, "forecast_seed": seed, "max_command": 2}, None) for seed in ("1", "2")),
    ]))
    assert [window["forecast"] for window in report.windows()] == [
        "perfect", "errors skill worse seed 7"
    ]
    assert [row["seeds"] for row in report.of(SEEDS)] == [2]
    assert [name for name in figures_of(report) if name.startswith(("fore", "traj"))] == [
        "trajectories-1-1", "trajectories-2-1", "forecast-errors"
    ]
    text = page_of(report)
    assert "Deviation, each run" in text and "over the minimum" not in text
    warned = text.partition("The command was above 1")[2].partition("</li>")[0]
    assert "</summary>003, 004</details>" in warned
    words = "nly 2 seeds: with fewer than 10, the worst tenth is a single run"
    assert words in text.partition("</header>")[0]
    assert words in text.partition('id="warnings"')[2]


def test_the_minimum_of_the_same_seeds(tmp_path: Path) -> None:
    """By hand: MPC is worse by 0.1 m3 with every seed, and failed with the worst, 25."""
    row = {**simulate("onoff", "0.5", "low-low").row, "forecast": "errors",
           "forecast_skill": "real", "parameter:fraction": ""}
    totals = {seed: 10.0 + seed for seed in range(1, 26)}
    report = study_of(tmp_path / "study", *(
        {**row, "controller": controller, "forecast_seed": seed, TOTAL: total + more,
         "status": "failed" if more and seed == 25 else "done"}
        for controller, more in (("onoff", 0.0), ("mpc", 0.1)) for seed, total in totals.items()
    ))
    assert "over the seeds was 23.00 m³ (on/off from low-low" in sentences(report)[1]
    assert cautions(report)[-1] == (
        "MPC (forecast errors) ran with as few as 24 of 25 seeds: its mean is of other seeds"
    )


def test_skills_in_the_order_of_their_names(tmp_path: Path) -> None:
    """From the best to the worst; then files, with any words in their names."""
    skills = ("a real one.yaml", "worse", "real", "much_better")
    row = {**simulate("onoff", "0.5", "low-low").row, "forecast": "errors"}
    report = study_of(tmp_path / "study", *(
        {**row, "forecast_skill": skill, "forecast_seed": seed} for skill in skills
        for seed in (1, 2)
    ))
    assert [row["skill"] for row in report.of(SEEDS)] == list(skills[::-1])


@pytest.mark.parametrize(("forecast", "seeds"), [("perfect", ("",)), ("errors", (1, 2))])
def test_a_tie_is_no_win(tmp_path: Path, forecast: str, seeds: tuple[object, ...]) -> None:
    row = {**simulate("onoff", "0.5", "low-low").row, "parameter:fraction": ""}
    totals = {1: (5, 6), 2: (5, 6), 3: (5, 5), 4: (5, 5), 5: (7, 6)}
    report = study_of(tmp_path / "study", *(
        {
            **row, "start": f"2021-07-0{day}T02:00:00-05:00", "controller": controller,
            "forecast": forecast, "forecast_seed": seed, TOTAL: total,
            "forecast_skill": "real" if seed else "",
        }
        for seed in seeds for day, both in totals.items()
        for controller, total in zip(("mpc", "onoff"), both, strict=True)
    ))
    assert "with MPC in 2, shared in 2 and with on/off in 1." in sentences(report)[1]


# --- the command ---------------------------------------------------------------------------------


def test_nothing_is_written_over(tmp_path: Path) -> None:
    """Neither an old report, without --force, nor a file that is not a report's."""
    (tmp_path / "figures").mkdir()
    (tmp_path / "report.html").touch()
    (tmp_path / "figures" / "energy-1.svg").touch()
    refusal(partial(_former_report, force=False), tmp_path, is_figure, match="with --force")
    (tmp_path / "figures" / "energy-2.svg").mkdir()
    (tmp_path / "figures" / "mine.svg").touch()
    (tmp_path / "notes.txt").touch()
    reason = refusal(partial(_former_report, force=True), tmp_path, is_figure)
    assert "figures/energy-2.svg, figures/mine.svg, notes.txt does not belong to a report" in reason


def test_study(tmp_path: Path) -> None:
    """A page, each figure twice, the failed runs with their errors, and where the page is.

    With --force the previous report is removed.
    """
    example = simulate("onoff", "2", "low-low")
    failed = {**example.row, "status": "failed", "error": "solver: <gave up>", TOTAL: ""}
    not_run = {**failed, "parameter:fraction": "3", "status": "not run", "error": ""}
    runs = (example.row, each_minute(example.trajectory)), (failed, None), (not_run, None)
    report = write_study(tmp_path / "study", runs) / "report"
    (report / "figures").mkdir(parents=True)
    (report / "figures" / "energy-7.svg").touch()
    options = ("--force", "--water-price", "5")
    done = command("study", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert str(report / "report.html") in done.stdout
    assert "fraction 2" in done.stdout
    text = (report / "report.html").read_text()
    for words in (
        "5 CAD/m³", "solver: &lt;gave up&gt;", "2 runs failed", "<td>not run</td>",
    ):
        assert words in text
    names = {path.stem for path in (report / "figures").iterdir()}
    assert names == {"weather-1", "trajectories-1-1", "water-balance-1"}
    for name in names:
        svg = (report / "figures" / f"{name}.svg").read_text()
        assert svg.startswith("<svg") and "<text" in svg
        png = (report / "figures" / f"{name}.png").read_bytes()
        width, height = struct.unpack(">II", png[16:24])
        assert png.startswith(b"\x89PNG") and width > 800 and height > 300
    payload = json.loads(text.partition('id="payload">')[2].partition("</script>")[0])
    assert {panel["figure"] for panel in payload["panels"]} == names


def test_a_page_begins_with_what_came_out(tmp_path: Path, study: Path, seeds: Report) -> None:
    """Three sentences and a figure come before the results; versions are last."""
    one = page_of(ended_run(tmp_path / "run"))
    assert "Smallest total deviation" not in one and "<thead>" not in one.partition("Site:")[0]
    pages = {
        "A run of MPC (weight 0.001): ": one,
        "8 runs of MPC (2 settings) and on/off (2 settings), from low-low and high-low: ":
        page_of(study),
        "600 runs of MPC and on/off (2 settings), from low-low and high-low: 4 sets of conditions.":
        page_of(seeds),
    }
    for first, text in pages.items():
        lead = text.partition('class="lead">')[2].partition("</p>")[0]
        assert lead.startswith(first)
        assert len(re.findall(r"\.(?= [A-Z]|$)", lead)) == 3
        order = ['<section id="results">', '<section id="figures">',
                 '<section id="configuration">', "Made with greenroof_ros"]
        places = list(map(text.index, order))
        assert places == sorted(places)
        warnings = text.find('<section id="warnings">')
        assert warnings == -1 or places[1] < warnings < places[2]
