"""Studies of on/off control, whose cases run together, against each case alone."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from graphs import wait_for
from places import DATA
from studies import begun, grid, rows_of, stored, study

from greenroof_ros.analysis.study.case import Case, collect_contents
from greenroof_ros.analysis.study.case_run import Outcome, group_cases, run_case, run_cases
from greenroof_ros.analysis.study.grid import read_grid
from greenroof_ros.analysis.workers.input_files import write_inputs
from greenroof_ros.analysis.workers.progress import ShareFile
from greenroof_ros.recording.events_table import EVENTS

WINDOWS = f"""
weather:
  - {{file: {DATA / "en_climate_hourly_07-2021.csv"}, start: 2021-07-07T00:00, hours: 60}}
  - {{file: {DATA / "en_climate_hourly_03-2021.csv"}, start: 2021-03-13T00:00, hours: 60}}
bound_block: 0
"""
LEVELS = "initial: {name: half, cistern_level: 0.6, roof_level: 0.036}"
GRIDS = {
    "valve": f"""
site:
  - {{file: site_valve.yaml, a1: [0.9, 4.3], tau: 60.0, M: [1, 3]}}
  - {{file: site_valve.yaml, a1: 1.3, tau: 300.0, time_zone: America/Toronto,
     quiet_hours: [["09:00-15:30", "23:00-04:00"]], valve_closed_in_frost: true}}
{WINDOWS}
{LEVELS}
controllers:
  onoff:
    - {{outlet: [closed, open], fraction: [0.35, 1.0]}}
    - {{outlet: drain, outlet_reserve: 0.7, level: 0.93}}
    - {{outlet: plan, outlet_price: 0.1, outlet_reach: 5.0,
       forecast: [perfect, {{model: ensemble, members: 3, seed: 2}}]}}
  lookahead: {{outlet: drain, forecast: perfect}}
""",
    "no valve": f"""
site:
  - {{file: [site.yaml, site_catchment.yaml], z_veg: 0.0457, tau: [60.0, 300.0], M: 1}}
  - {{file: site_valve.yaml, low_outlet_valve: false, tau: 60.0, drainage_to_cistern: 0.7}}
{WINDOWS}
{LEVELS}
controllers: {{onoff: {{level: [1.0, 0.9]}}}}
sensor_and_pump: [{{}}, {{roof_noise: 0.001}}]
""",
}


def prepared(directory: Path, text: str) -> list[Case]:
    """Return the cases of a grid, whose input files are in its directory then."""
    cases = read_grid(directory / grid(directory, text))
    write_inputs(collect_contents(cases), directory)
    return cases


def run_together(directory: Path, group: Sequence[Case]) -> list[Outcome | Exception]:
    return run_cases(directory, group, None, ShareFile(directory / "share"))


def numbers(value: Any) -> Any:
    """Return the number or the numbers of a cell; others as they are."""
    try:
        return [float(part) for part in value.split()] if isinstance(value, str) else value
    except ValueError:
        return value


def check_rows(found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Compare two rows of a table: counts and texts are equal, other numbers to rounding."""
    assert list(found) == list(expected)
    for name, value in expected.items():
        one, other = numbers(found[name]), numbers(value)
        if isinstance(other, (float, list)):
            other = pytest.approx(other, rel=1e-9, abs=1e-9)
        assert one == other, name


@pytest.mark.parametrize("name", GRIDS)
def test_results_and_events_are_those_of_each_case_alone(tmp_path: Path, name: str) -> None:
    """Sites with and without valve, mains, frost, quiet hours, and both kinds of soil."""
    cases = prepared(tmp_path, GRIDS[name])
    groups = [group for group in group_cases(cases, 2, None) if len(group) > 1]
    assert {case.identity for group in groups for case in group} == {
        case.identity for case in cases
        if case.controller == "onoff" and not case.inputs.sensor_and_pump.roof_noise
    }
    pumped = False
    for group in groups:
        for case, found in zip(group, run_together(tmp_path, group), strict=True):
            assert isinstance(found, Outcome)
            alone = run_case(tmp_path, case, None)
            check_rows(found.results, alone.results)
            events = [
                list(csv.DictReader(io.StringIO(outcome.files[EVENTS].decode())))
                for outcome in (found, alone)
            ]
            for one, other in zip(*events, strict=True):
                check_rows(one, other)
            pumped = pumped or found.results["pump_starts"] > 0
    assert pumped


def test_only_what_arrays_cover_is_grouped(tmp_path: Path) -> None:
    cases = prepared(tmp_path, GRIDS["no valve"])
    exact = [case for case in cases if not case.inputs.sensor_and_pump.roof_noise]
    assert {len(group) for group in group_cases(cases, 2, 0.0)} == {1}  # with trajectories
    assert {len(group) for group in group_cases(exact[:3], 2, None)} == {1}
    short = prepared(tmp_path, GRIDS["no valve"].replace("tau: [60.0, 300.0], M: 1", "tau: 1.0"))
    assert {case.together for case in short} == {(60.0, 3600), None}
    assert {case.together for case in short if "tau-1" in case.site.name} == {None}
    for workers in (1, 3, 50):
        groups = group_cases(exact * 200, workers, None)
        assert all(len({case.together for case in group}) == 1 for group in groups)
        assert max(map(len, groups)) <= 100
        assert sum(map(len, groups)) == 200 * len(exact)


def test_an_error_of_one_case_is_its_own(tmp_path: Path) -> None:
    cases = prepared(tmp_path, GRIDS["no valve"])
    group, *_ = (group for group in group_cases(cases, 1, None) if len(group) > 4)
    lost = replace(group[1], weather=(replace(group[1].weather[0], name="lost.csv"),))
    first, failed, *others = run_together(tmp_path, [group[0], lost, *group[2:]])
    assert isinstance(failed, Exception)
    assert "lost.csv" in str(failed)
    assert all(isinstance(outcome, Outcome) for outcome in (first, *others))


def test_every_case_of_a_group_keeps_its_error(tmp_path: Path) -> None:
    group = prepared(tmp_path, GRIDS["no valve"])[:4]
    lost = [
        replace(case, weather=(replace(case.weather[0], name="lost.csv"),)) for case in group
    ]
    for failed in run_together(tmp_path, lost):
        assert "lost.csv" in str(failed)


def test_killed_and_continued(tmp_path: Path) -> None:
    """Two groups in one worker: the second is lost and runs again, the first does not."""
    text = GRIDS["no valve"].replace("hours: 60", "hours: 600", 1).replace("03-13", "03-10")
    text = text.replace("2021-07-07", "2021-07-02").replace(", {roof_noise: 0.001}", "")
    cases = prepared(tmp_path, text)
    options = "--no-trajectories", "--jobs", "1"
    process = begun(tmp_path, *options)
    wait_for(lambda: stored(tmp_path), 120, "a group")
    process.kill()
    process.communicate()
    there = {run: (run / "outcome.json").stat().st_mtime_ns for run in stored(tmp_path)}
    assert len(there) < len(cases)
    result = study(tmp_path, "grid.yaml", "--output", "out", *options)
    assert result.returncode == 0, result.stderr
    (kept,) = re.findall(rf"(\d+) of {len(cases)} runs are already stored", result.stderr)
    assert int(kept) >= len(there)
    for run, written in there.items():
        assert (run / "outcome.json").stat().st_mtime_ns == written
    rows = rows_of(tmp_path / "out" / "results.csv")
    assert [row["status"] for row in rows] == ["done"] * len(cases)
    shortest = min(range(len(cases)), key=lambda place: cases[place].hours)
    expected = run_case(tmp_path, cases[shortest], None).results
    found = {name: rows[shortest][name] for name in expected}
    assert float(found["pumped_m3"]) == pytest.approx(expected["pumped_m3"], rel=1e-9)
