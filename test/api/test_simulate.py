"""The Python API: the command's numbers, from every kind of controller, site and weather."""

from __future__ import annotations

import csv
import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
from commands import run_command
from graphs import environment
from places import CHECKOUT, CONFIG, refusal

import greenroof_ros as gr
from greenroof_ros.analysis.report.runs import find_runs
from greenroof_ros.api.simulate import ForecastSteps, SiteState
from greenroof_ros.base.errors import ConfigurationError
from greenroof_ros.controllers.onoff import OnOff

PAPERS = CONFIG / "weather" / "toronto_2021-07.csv"
# What depends on the machine, and the directory.
OTHER = {"wall_s", "times_real_time", "solver"}


def of_command(directory: Path, *options: str) -> dict[str, object]:
    done = run_command(
        "simulate", "--json", "--output", "out", *options, cwd=directory, env=environment(0),
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


def test_the_numbers_are_the_commands(tmp_path: Path) -> None:
    """Summary and trajectory, digit for digit."""
    site = CONFIG / "site_neubrandenburg.yaml"
    expected = of_command(
        tmp_path, "--trajectory", "--controller", "lookahead", "--hours", "0.3", "--horizon", "12",
        "--forecast", "errors", "--forecast-seed", "3", "--forecast-skill", "none",
        "--start", "2021-07-08T05:00", "--cistern", "60", "--roof", "2", "--site", str(site),
        "--evapotranspiration", "fao56", "--roof-noise", "0.25", "--noise-seed", "3",
        "--roof-offset", "-0.01", "--pump-min-on", "60", "--pump-min-off", "90",
    )
    result = gr.simulate(
        "lookahead", hours=0.3, horizon=12, forecast="errors", forecast_seed=np.int64(3),
        forecast_skill="none", start=datetime.fromisoformat("2021-07-08T05:00"),
        initial=(60.0, 2.0), site=site, evapotranspiration="fao56", roof_noise=np.float32(0.25),
        noise_seed=3, roof_offset=-0.01, pump_min_on=60, pump_min_off=np.int64(90),
    )
    ours = json.loads(json.dumps(result.summary))
    assert {key for key in expected if ours[key] != expected[key]} <= OTHER
    assert result.metrics.items() <= expected.items()
    with (tmp_path / "out" / "trajectory.csv").open() as stream:
        rows = list(csv.reader(stream))
    frame = result.trajectory
    assert sorted(frame.columns) == sorted(rows[0])
    for name, *cells in zip(*rows, strict=True):
        if name == "time":
            assert frame[name].to_list() == [datetime.fromisoformat(cell) for cell in cells]
        else:
            assert frame[name].to_list() == [float(cell) for cell in cells], name


def test_every_kind_of_controller() -> None:
    """A name, its class and a function are one controller."""
    named = gr.simulate("onoff", hours=1)
    site = gr.read_site()

    def by_levels(state: SiteState, forecast: ForecastSteps) -> bool:
        return state.roof_level < site.z_veg and state.cistern_level >= site.suction_level

    for other in (OnOff, by_levels):
        result = gr.simulate(other, hours=1)
        assert result.metrics == named.metrics
        assert result.trajectory.equals(named.trajectory)


def test_what_a_function_gets() -> None:
    """Time, levels, and the rain of the file as means over steps whose ends come with it.

    At 02:00 the file has 0, 0.2 and 3.0 mm in the next three hours, 0.0 after that.
    """
    seen = []

    def never(state: SiteState, forecast: ForecastSteps) -> float:
        seen.append((state, forecast))
        return 0.0

    result = gr.simulate(never, hours=0.01, horizon=4)
    state, forecast = seen[0]
    assert [each.time.isoformat() for each, _ in seen[:2]] == [
        "2021-07-07T02:00:00-05:00", "2021-07-07T02:00:01-05:00",
    ]
    assert len(seen) == result.trajectory.height == 37
    assert (state.cistern, state.roof) == pytest.approx((75 / 1.3, 68.8 * 0.0457 / 1.3))
    ends = forecast.ends
    assert (ends[0], ends[-1]) == (0.0, 4 * 3600.0)
    assert len(forecast.rain) == len(forecast.evapotranspiration) == len(ends) - 1
    depths = 1000 * forecast.rain * np.diff(ends)
    for hour, depth in enumerate((0.0, 0.2, 3.2, 3.2), start=1):
        if 3600.0 * hour in ends:
            assert depths[ends[1:] <= 3600.0 * hour].sum() == pytest.approx(depth)
    assert depths.sum() == pytest.approx(3.2)


def test_weather_in_a_data_frame(tmp_path: Path) -> None:
    """It gives the file's numbers, whoever made the frame; a saved run has a file of it."""
    expected = gr.simulate("onoff", hours=3).metrics
    text = [line for line in PAPERS.read_text().splitlines() if line[0] != "#"]
    frame = polars.read_csv("\n".join(text).encode())
    zoned = frame.with_columns(
        polars.col("time").str.to_datetime("%Y-%m-%dT%H:%M%z", time_zone="Etc/GMT+5")
    )
    for each in (frame, zoned):
        result = gr.simulate("onoff", weather=each, hours=3)
        assert result.metrics == expected
    (copy,) = (result.save(tmp_path / "mine") / "configuration" / "weather").iterdir()
    assert gr.simulate("onoff", weather=copy, hours=3).metrics == expected
    gap = zoned.with_columns(polars.when(polars.col("time").dt.hour() == 4).then(
        math.nan).otherwise(polars.col("precipitation [mm/h]")).alias("precipitation [mm/h]"))
    with pytest.raises(ConfigurationError, match="precipitation is missing at 2021-07-07T04:00"):
        gr.simulate("onoff", weather=gap, hours=3)
    with pytest.warns(UserWarning, match="precipitation is missing at 2021-07-07T04.*filled with"):
        filled = gr.simulate("onoff", weather=gap, hours=3, gaps="fill")
    assert filled.metrics["rain_roof_m3"] == pytest.approx(0.0002 * 68.8)


@pytest.mark.parametrize("way", [gr.simulate, gr.Environment])
def test_what_the_command_notes_is_a_warning(way: Callable[..., Any]) -> None:
    """Once, at the line here, without an option of a command."""
    sydney = gr.read_site(latitude=-33.87, longitude=151.21)
    with pytest.warns(UserWarning, match="km from") as shown:
        way(site=sydney, hours=0.01)
    (far,) = (each for each in shown if re.search("W, 15\\d{3} km from", str(each.message)))
    assert far.filename == __file__ and "--" not in str(far.message)


@pytest.mark.parametrize(("every", "kept"), [
    (None, range(37)), (0, range(37)), (7, [0, 7, 14, 21, 28, 35, 36]), (9.4, [0, 9, 18, 27, 36]),
    (1e6, [0, 36]),
])
def test_a_trajectory_of_some_ticks(every: float | None, kept: Sequence[int]) -> None:
    """The first and the last are among them; the results are of all ticks."""
    whole = gr.simulate("onoff", hours=0.01)
    result = gr.simulate("onoff", hours=0.01, trajectory_every=every)
    assert result.trajectory.equals(whole.trajectory[list(kept)])
    assert result.metrics == whole.metrics


def test_what_is_a_command() -> None:
    """Also the only number in an array, as solvers return it."""

    def run(command: Any) -> dict[str, float]:
        def decide(state: SiteState, forecast: ForecastSteps) -> Any:
            return command

        return gr.simulate(decide, hours=0.01).metrics

    for command in (np.array([[0.5]]), np.float32(0.5)):
        assert run(command) == run(0.5)
    for command in (np.array([0.5, 0.5]), "no", None, np.array([]), math.nan, -1.0, 1.2):
        refusal(run, command, match=(
            f"{Path(__file__).name}, line .*: the command of decide = .*: must be"
        ))


def test_numbers_of_numpy(tmp_path: Path) -> None:
    """They are the numbers that they equal, in runs, sites and what is saved of them."""
    months = np.linspace(0.5, 6.0, 12)
    site = replace(
        gr.read_site(z_veg=np.float64(0.04), monthly_evapotranspiration=months),
        d=np.float32(11.0), N=np.int64(360),
    )
    result = gr.simulate(
        "anticipating_onoff", site=site, horizon=np.int64(24), hours=np.float32(0.25),
        initial=np.array([60.0, 2.0]), waiting_share=np.float16(0.5),
        start=np.datetime64("2021-07-07T03:00", "ns"),
    )
    plain = gr.simulate(
        "anticipating_onoff", horizon=24.0, hours=0.25, initial=(60.0, 2.0), waiting_share=0.5,
        site=gr.read_site(z_veg=0.04, d=11.0, N=360, monthly_evapotranspiration=months.tolist()),
        start="2021-07-07T03:00",
    )
    assert result.metrics == plain.metrics
    directory = result.save(tmp_path / "run")
    assert gr.read_site(directory / "configuration" / "site.yaml") == plain.run.site


ROWS: dict[str, list[Any]] = {
    "precipitation [mm/h]": [0.0] * 24, "my evapotranspiration [mm/day]": [2.5] * 24,
    "time": [f"2024-06-01T{hour:02}:00Z" for hour in range(24)],
}


@pytest.mark.parametrize(("column", "values", "message"), [
    ("precipitation [mm/h]", [0.0] * 7 + [5e3] * 2 + [0.0] * 15,
     r"^the data frame, row 7: precipitation \[mm/h\] = '5000.0': must be a number from 0 to 2000"),
    ("temperature [degC]", [20.0] * 2 + [None] * 22,
     "^the data frame: temperature is missing at 2024-06-01T02:00.*or fill the gaps .gaps: fill.,"),
])
@pytest.mark.parametrize("library", ["polars", "pandas"])
def test_what_is_wrong_in_a_data_frame(
    library: str, column: str, values: list[Any], message: str
) -> None:
    """Row and column, no file, and no option of a command."""
    frame = pytest.importorskip(library).DataFrame({**ROWS, column: values})
    error = refusal(lambda: gr.simulate(
        "onoff", weather=frame, start="2024-06-01T00:00", hours=4), match=message)
    assert "--" not in error and "/tmp" not in error


def test_weather_and_trajectory_in_pandas() -> None:
    """With a column or an index of times; the trajectory keeps its time zone."""
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    expected = gr.simulate("onoff", hours=3)
    frame = pandas.read_csv(PAPERS, comment="#", parse_dates=["time"])
    for each in (frame, frame.set_index("time")):
        assert gr.simulate("onoff", weather=each, hours=3).metrics == expected.metrics
    table = expected.trajectory.to_pandas()
    assert table["time"].iloc[-1] == pandas.Timestamp("2021-07-07T05:00-05:00")
    assert table["roof_m3"].iloc[-1] == expected.metrics["final_roof_m3"]


def test_sites(tmp_path: Path) -> None:
    """A file, what is read from it, and changed values."""
    (tmp_path / "low.yaml").write_text("extends: site.yaml\nz_veg: 0.04\n")
    expected = gr.simulate("onoff", site=tmp_path / "low.yaml", hours=1)
    assert expected.run.site.x2_star == pytest.approx(68.8 * 0.04)
    for site in (gr.read_site(tmp_path / "low.yaml"), gr.read_site(z_veg=0.04)):
        assert gr.simulate("onoff", site=site, hours=1).metrics == expected.metrics


@pytest.mark.parametrize(("inputs", "reason"), [
    ({"hour": 3}, "hour = 3: .*did you mean hours"),
    ({"hours": np.bool_(True)}, "hours = "), ({"weather": 3}, "weather = 3"),
    ({"initial": (60.0,)}, "initial = "), ({"controller": object}, "is not a controller"),
])
def test_what_is_wrong_is_named(inputs: dict[str, object], reason: str) -> None:
    refusal(lambda: gr.simulate(**inputs), match=reason)  # type: ignore[arg-type]


def test_a_saved_run_is_read_by_the_report(tmp_path: Path) -> None:
    """As the directory of a run, with its trajectory; nothing is overwritten."""
    result = gr.simulate(
        "onoff", level=0.9, site=CONFIG / "site_neubrandenburg.yaml", start="2021-07-08T10:00",
        hours=2,
    )
    assert result.save(tmp_path / "mine") == tmp_path / "mine"
    refusal(result.save, tmp_path / "mine", match="never overwrites")
    (run,) = find_runs([tmp_path / "mine"]).runs
    assert run.row["total_deviation_m3"] == result.metrics["total_deviation_m3"]
    trajectory = run.trajectory()
    assert trajectory is not None
    assert trajectory.roof.tolist() == result.trajectory["roof_m3"].to_list()
    assert gr.read_bag(tmp_path / "mine").equals(result.trajectory)
    layer = result.trajectory["drainage_layer_m3"]
    assert layer[-1] == result.metrics["final_layer_m3"] > layer[0]
    (tmp_path / "mine" / "trajectory.parquet").unlink()
    refusal(gr.read_bag, tmp_path / "mine")


def test_a_bag_has_the_same_trajectory(recorded: Path) -> None:
    """As the simulation; volumes come from levels, rounded once more."""
    frame = gr.read_bag(recorded)
    expected = gr.simulate("mpc", hours=0.1).trajectory
    assert frame.columns == [name for name in expected.columns if name != "wet"]
    assert frame["time"].equals(expected["time"])
    for name in frame.columns[1:]:
        np.testing.assert_allclose(frame[name], expected[name], rtol=1e-12, atol=0, err_msg=name)


def test_importing_it_loads_nothing() -> None:
    """Neither numpy nor what is in the package."""
    code = (
        "import sys, greenroof_ros; "
        "print([name for name in sys.modules if name[:5] in ('green', 'numpy')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=CHECKOUT
    )
    assert done.stdout == "['greenroof_ros']\n"
    for name in set(gr.__all__) - {"scenarios"}:
        assert getattr(gr, name).__name__ == name
