"""Studies: the paper's 30 runs, interruptions, failures, engines, and wrong grids."""

from __future__ import annotations

import csv
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from graph import Process, wait_for_ticks

from greenroof_ros.files import shared_directory
from greenroof_ros.report.runs import find_runs
from greenroof_ros.study.grid import read_grid
from greenroof_ros.trajectory import read_parquet

CONFIG = shared_directory() / "config"
WEATHER = CONFIG / "weather" / "toronto_2021-07.csv"
REAL = Path(__file__).resolve().parents[2] / "shared" / "weather"

GRID = f"""
site: {CONFIG / "site.yaml"}
weather:
  - file: {WEATHER}
    start: 2021-07-07T02:00
    hours: 0.25
    evapotranspiration: [published, fao56]
initial: [low-low, {{name: dry, cistern: 40.0, roof: 0.5}}]
controllers:
  mpc:
    weight: [1.0e-3, 0.1]
    max_command: 1.0
  onoff:
"""


def study(directory: Path, *options: str, timeout: float = 300) -> subprocess.CompletedProcess[str]:
    """Run the command to its end."""
    return subprocess.run(
        [sys.executable, "-m", "greenroof_ros.study", *options],
        cwd=directory, capture_output=True, text=True, timeout=timeout, check=False,
    )


def grid(directory: Path, text: str = GRID) -> str:
    """Write a grid."""
    (directory / "grid.yaml").write_text(text)
    return "grid.yaml"


def rows_of(file: Path) -> list[dict[str, str]]:
    """Read a table."""
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's study, as the command without options makes it."""
    directory = tmp_path_factory.mktemp("study")
    result = study(directory)
    assert result.returncode == 0, result.stderr
    assert "7151.78" in result.stdout
    return directory / "studies" / "paper"


def test_the_papers_table(papers: Path) -> None:
    """All 30 totals within 0.02 % of those of the authors' code."""
    rows = rows_of(papers / "results.csv")
    expected = rows_of(CONFIG / "paper" / "totals.csv")
    assert len(rows) == len(expected) == 30
    totals = {}
    for row in rows:
        assert (row["status"], row["error"]) == ("done", "")
        parameter = row["weight"] if row["controller"] == "mpc" else row["fraction"]
        totals[row["initial"], row["controller"], float(parameter)] = row
    for row in expected:
        mine = totals[row["initial"], row["controller"], float(row["parameter"])]
        assert float(mine["total_deviation_m3"]) == pytest.approx(
            float(row["total_deviation_m3"]), rel=2e-4
        )
        assert float(mine["final_roof_m3"]) == pytest.approx(float(row["final_roof_m3"]), rel=2e-5)
        assert float(mine["max_command_applied"]) == pytest.approx(
            float(row["max_command"]), rel=1e-3, abs=1e-9
        )


def test_killed_and_gone_on(papers: Path, tmp_path: Path) -> None:
    """Killed at a random moment, again and again: the same table, and no run twice."""
    seed = random.randrange(1000)
    chance = random.Random(seed)
    print("seed", seed)
    for _ in range(3):
        process = subprocess.Popen(
            [sys.executable, "-m", "greenroof_ros.study"], cwd=tmp_path,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )
        time.sleep(chance.uniform(1, 6))
        process.kill()
        process.wait()
    runs = tmp_path / "studies" / "paper" / "runs"
    there = {
        path.name: (path / "outcome.json").read_bytes()
        for path in runs.glob("*") if path.suffix != ".part"
    }
    result = study(tmp_path)
    assert result.returncode == 0, result.stderr
    if there:
        assert f"{len(there)} of 30 runs are there already" in result.stderr
    for name, outcome in there.items():  # its timings would differ, had it run again
        assert (runs / name / "outcome.json").read_bytes() == outcome
    assert not list(runs.glob("*.part"))
    table = tmp_path / "studies" / "paper" / "results.csv"
    assert table.read_bytes() == (papers / "results.csv").read_bytes()
    again = study(tmp_path)
    assert (again.returncode, again.stdout) == (0, result.stdout)


def children(process: int) -> Iterator[int]:
    """Yield all processes under a process."""
    for child in Path(f"/proc/{process}/task/{process}/children").read_text().split():
        yield int(child)
        yield from children(int(child))


def workers(process: int) -> list[int]:
    """Return the processes that are on a run: a second's work of the fork server's children."""
    starters = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    busy = []
    for starter in starters:
        for child in children(int(starter)):
            ticks = Path(f"/proc/{child}/stat").read_text().rsplit(")", 1)[1].split()
            if int(ticks[11]) > 100:
                busy.append(child)
    return busy


def test_a_killed_worker_fails_its_run_alone(tmp_path: Path) -> None:
    """The others go on; the failure is in the table; the next call makes it good."""
    text = GRID.replace("hours: 0.25", "hours: 24")
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros.study", grid(tmp_path, text), "--output", "out",
         "--jobs", "2"],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )
    until = time.monotonic() + 30
    while not (found := workers(process.pid)):
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(found[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "failed: mpc" in errors
    assert "Traceback" not in errors
    rows = rows_of(tmp_path / "out" / "results.csv")
    failed = [row for row in rows if row["status"] == "failed"]
    assert len(failed) == 1
    assert failed[0]["error"]
    assert failed[0]["total_deviation_m3"] == ""
    assert all(row["total_deviation_m3"] for row in rows if row["status"] == "done")
    result = study(tmp_path, "grid.yaml", "--output", "out")
    assert result.returncode == 0
    assert "11 of 12 runs are there already" in result.stderr
    assert {row["status"] for row in rows_of(tmp_path / "out" / "results.csv")} == {"done"}


def test_interrupted(tmp_path: Path) -> None:
    """Ctrl-C: nothing is left behind, what is finished is in the table, the rest can follow."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "greenroof_ros.study"], cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(scratch)},
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )
    runs = tmp_path / "studies" / "paper" / "runs"
    until = time.monotonic() + 60
    while len(list(runs.glob("*"))) < 2:
        assert time.monotonic() < until
        time.sleep(0.05)
    group = list(children(process.pid))
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in errors
    until = time.monotonic() + 5
    while any(Path(f"/proc/{child}").exists() for child in group):
        assert time.monotonic() < until
        time.sleep(0.05)
    assert not list(scratch.iterdir())
    status = [row["status"] for row in rows_of(runs.parent / "results.csv")]
    assert status.count("done") >= 2
    assert status.count("done") + status.count("not run") == 30


def test_engines_give_the_same_table(tmp_path: Path) -> None:
    """Bit for bit: the loop in process, and real graphs, each in a domain of its own."""
    name = grid(tmp_path, edited("[low-low, ", "[").replace("[published, fao56]", "fao56"))
    assert study(tmp_path, name, "--output", "loop").returncode == 0
    result = study(tmp_path, name, "--output", "graph", "--engine", "ros")
    assert result.returncode == 0, result.stderr
    loop, graph = tmp_path / "loop", tmp_path / "graph"
    assert (loop / "results.csv").read_bytes() == (graph / "results.csv").read_bytes()
    rows = rows_of(graph / "results.csv")
    assert len(rows) == 3
    for row in rows:
        assert (graph / "runs" / row["run"] / "bag" / "bag_0.mcap").is_file()


def archive(directory: Path) -> None:
    """Write a file of forecasts of which nothing will come true."""
    lines = ["issued,time,precipitation [mm/h]"]
    lines += [f"2021-07-07T05:00Z,2021-07-07T{hour:02}:00Z,4.0" for hour in range(5, 22)]
    (directory / "archive.csv").write_text("\n".join(lines) + "\n")


FORECASTS = "forecast: [perfect, {model: errors, size: 0.5, seed: [1, 2]}, archive.csv]\n"
PLANNED = f"""
site: {CONFIG / "site.yaml"}
weather: {{file: {WEATHER}, start: 2021-07-07T00:50, hours: 0.25}}
initial: low-low
controllers: {{planning_mpc: }}
"""


def test_forecasts(tmp_path: Path) -> None:
    """Lists multiply; a window's own come before those of all; each run says which it had."""
    archive(tmp_path)
    result = study(tmp_path, grid(tmp_path, PLANNED + FORECASTS), "--output", "out")
    assert result.returncode == 0, result.stderr
    assert "errors size 0.5 seed 1" in " ".join(result.stdout.split())
    rows = rows_of(tmp_path / "out" / "results.csv")
    columns = ("forecast", "forecast_size", "forecast_seed", "forecast_members")
    assert [tuple(row[column] for column in columns) for row in rows] == [
        ("perfect", "", "", ""),
        ("errors", "0.5", "1", ""),
        ("errors", "0.5", "2", ""),
        ("archive.csv", "", "", ""),
    ]
    header = list(rows[0])
    assert header.index("evapotranspiration") + 1 == header.index("forecast")
    assert header.index("forecast_members") + 1 == header.index("controller")
    assert len({row["run"] for row in rows}) == 4
    # Rain is coming by the file alone, so that less is pumped.
    pumped = [float(row["pumped_m3"]) for row in rows]
    assert pumped[3] < min(pumped[:3])
    kept = tmp_path / "out" / "configuration" / "archive.csv"
    assert kept.read_bytes() == (tmp_path / "archive.csv").read_bytes()
    report = [run.forecast for run in find_runs([tmp_path / "out"], None).runs]
    assert report == ["", "errors size 0.5 seed 1", "errors size 0.5 seed 2", "archive.csv"]

    own = PLANNED.replace("hours: 0.25", "hours: 0.25, forecast: persistence") + FORECASTS
    assert [str(case.forecast) for case in read_grid(tmp_path / grid(tmp_path, own))] == [
        "persistence"
    ]
    before = [case.identity for case in read_grid(tmp_path / grid(tmp_path, PLANNED + FORECASTS))]
    archived = tmp_path / "archive.csv"
    archived.write_text(archived.read_text().replace("4.0", "5.0"))
    after = [case.identity for case in read_grid(tmp_path / "grid.yaml")]
    assert after[:3] == before[:3] and after[3] != before[3]


def test_forecasts_by_both_engines(tmp_path: Path) -> None:
    """The graph is told the same."""
    archive(tmp_path)
    name = grid(tmp_path, PLANNED + "forecast: [archive.csv, {model: ensemble, members: 3}]\n")
    for engine in ("inprocess", "ros"):
        result = study(tmp_path, name, "--output", engine, "--engine", engine)
        assert result.returncode == 0, result.stderr
    loop, graph = (tmp_path / engine / "results.csv" for engine in ("inprocess", "ros"))
    assert loop.read_bytes() == graph.read_bytes()
    # As the page does, of a bag with its summary and of a study alike.
    bags = [tmp_path / "ros" / "runs" / row["run"] for row in rows_of(graph)]
    labels = [run.forecast for run in find_runs(bags, None).runs]
    assert labels == ["archive.csv", "ensemble size 0.5 seed 0 members 3"]


IMPERFECT = """
imperfections:
  - {}
  - {roof_noise: 0.0005, roof_offset: [-1.0e-5, 0.002], noise_seed: [1, 2], minimum_on: 60,
     minimum_off: 90}
"""


def test_imperfections_by_both_engines(tmp_path: Path) -> None:
    """Lists multiply; the same table by both; what a trajectory has of the roof is the truth."""
    text = PLANNED.replace("planning_mpc:", "onoff: {fraction: 0.3}") + IMPERFECT
    for engine in ("inprocess", "ros"):
        result = study(tmp_path, grid(tmp_path, text), "--output", engine, "--engine", engine)
        assert result.returncode == 0, result.stderr
    loop, graph = (tmp_path / engine / "results.csv" for engine in ("inprocess", "ros"))
    assert loop.read_bytes() == graph.read_bytes()
    rows = rows_of(loop)
    names = ["roof_noise", "roof_offset", "noise_seed", "minimum_on", "minimum_off"]
    assert [tuple(float(row[name]) for name in names) for row in rows] == [
        (0, 0, 0, 0, 0),
        (0.0005, -1e-5, 1, 60, 90),
        (0.0005, -1e-5, 2, 60, 90),
        (0.0005, 0.002, 1, 60, 90),
        (0.0005, 0.002, 2, 60, 90),
    ]
    header = list(rows[0])
    first = header.index("forecast_members") + 1
    assert header[first : header.index("controller")] == names
    assert len({row["run"] for row in rows}) == 5
    # A sensor that reads too little is overruled by Eq. (3a); one that reads too much is believed.
    assert len({row["final_roof_m3"] for row in rows}) == 3
    assert len({row["bound_m3"] for row in rows}) == 1
    assert all(int(row["pump_starts"]) >= 1 and float(row["energy_kwh"]) > 0 for row in rows)
    for row in rows:
        name = Path("runs") / row["run"] / "trajectory.parquet"
        true, replayed = (
            read_parquet(tmp_path / engine / name).roof for engine in ("inprocess", "ros")
        )
        if row["roof_noise"] == "0.0":
            assert replayed == pytest.approx(true, rel=1e-12)
        else:
            assert replayed.tobytes() == true.tobytes()

    plain = read_grid(tmp_path / grid(tmp_path, PLANNED))
    told = read_grid(tmp_path / grid(tmp_path, PLANNED + IMPERFECT))
    assert len({case.identity for case in (*plain, *told)}) == 6
    assert not set(names) & plain[0].columns().keys()


def test_dask(tmp_path: Path) -> None:
    """The same table from a cluster of two workers; exit code 2 where nobody answers."""
    from distributed import LocalCluster

    archive(tmp_path)
    name = grid(tmp_path, GRID.replace("02:00", "01:00") + "forecast: archive.csv\n")
    assert study(tmp_path, name, "--output", "here").returncode == 0
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        result = study(
            tmp_path, name, "--output", "there", "--scheduler", cluster.scheduler_address
        )
    assert result.returncode == 0, result.stderr
    here, there = (tmp_path / each / "results.csv" for each in ("here", "there"))
    assert here.read_bytes() == there.read_bytes()
    result = study(tmp_path, name, "--output", "nowhere", "--scheduler", "tcp://127.0.0.1:9")
    assert result.returncode == 2
    assert "--scheduler = 'tcp://127.0.0.1:9': does not answer" in result.stderr
    assert "Traceback" not in result.stderr


def test_windows_of_july(tmp_path: Path) -> None:
    """Three windows of the real month, one of them with hours that were missing."""
    file = REAL / "en_climate_hourly_07-2021.csv"
    if not file.is_file():
        pytest.skip(f"the real file {file.name} is not beside this checkout")
    text = GRID.replace(str(WEATHER), str(file)).replace("[published, fao56]", "fao56")
    text = text.replace("hours: 0.25", "hours: 12").replace(
        "2021-07-07T02:00", "[2021-07-08T05:00, 2021-07-16T08:00, 2021-07-20T12:00]"
    )
    result = study(tmp_path, grid(tmp_path, text), "--output", "out")
    assert result.returncode == 0, result.stderr
    assert "NOTE: 6 of 18 runs had missing hours of weather filled in" in result.stdout
    rows = rows_of(tmp_path / "out" / "results.csv")
    assert len(rows) == 18
    for row in rows:
        assert row["evapotranspiration"] == "fao56"
        filled = row["start"].startswith("2021-07-20")
        assert (row["filled_hours"] != "0") == filled
        assert ("dew point: 2021-07-20T12:00-05:00 to" in row["filled"]) == filled
    # 23 mm in the storm of 8 July, over the roof and the inlet.
    storm = 0.023 * (68.8 + 0.2922466566)
    rain = [float(row["rain_m3"]) for row in rows if row["start"].startswith("2021-07-08")]
    assert rain == pytest.approx([storm] * 6, rel=0.03)


def edited(old: str, new: str) -> str:
    """Return the grid with something else in it."""
    assert old in GRID
    return GRID.replace(old, new)


WRONG = {
    "empty": ("\n", "is empty"),
    "no-mapping": ("- a\n", "must hold 'key: value' lines"),
    "no-yaml": ("site: [\n", "is not valid YAML"),
    "unknown-key": (GRID + "engine: ros\n", "line 14: engine: is not known here"),
    "no-weather": (GRID[: GRID.index("weather")], "weather: is missing or empty"),
    "no-site-file": (edited("site.yaml", "absent.yaml"), "absent.yaml: cannot be read"),
    "no-weather-file": (edited("toronto", "absent"), "cannot be read: No such file"),
    "no-start": (edited("    start: 2021-07-07T02:00\n", ""), "start: is missing in a window"),
    "start": (edited("2021-07-07T02:00", "noon"), "line 5: start = 'noon': must be a time such as"),
    "uncovered": (edited("2021-07-07T02:00", "2022-07-07T02:00"), "but the run is from 2022-07-07"),
    "hours": (edited("0.25", "0"), "line 6: hours = 0.0: must be a whole number of ticks"),
    "hours-list": (edited("0.25", "[0.25, -1]"), "line 6: hours = -1.0: must be a whole number"),
    "files": (edited(str(WEATHER), f"[{WEATHER}, b.csv]"), "line 4: file: must be one value, not"),
    "names": (edited("name: dry", "name: [a, b]"), "name: must be one value, not a list"),
    "volumes": (edited("cistern: 40.0", "cistern: [40, 41]"), "cistern: must be one value, not a"),
    "state-list": (edited("[low-low,", "[[low-low],"), "initial: ['low-low'] must be one of low-l"),
    "hours-text": (edited("0.25", "long"), "line 6: hours = 'long': must be a number"),
    "variant": (edited("published, fao56", "hargreaves"), "'hargreaves': must be fao56, or publ"),
    "window": (edited("    hours", "    length"), "line 6: length: is not known here; there are f"),
    "initial": (edited("low-low", "low"), "line 8: initial: 'low' must be one of low-low, hig"),
    "volume": (edited("roof: 0.5", "roof: -0.5"), "initial: volumes must not be negative"),
    "half-state": (edited(", roof: 0.5", ""), "initial: a state has no roof"),
    "state-twice": (edited("name: dry", "name: low-low"), "initial: has low-low twice"),
    "level": (edited("cistern: 40.0", "cistern: 4.0e+6"), "m on /cistern/level, where at most 100"),
    "controller": (edited("onoff:", "pid:"), "line 13: pid: is not known here; there are mpc, o"),
    "parameter": (edited("weight", "wieght"), "wieght: is not known here; there are weight, max_c"),
    "value": (edited("0.1]", "-0.1]"), "line 11: weight: -0.1 must be from 1e-09 to 1e+06"),
    "text-value": (edited("0.1]", "small]"), "line 11: weight: must be a number, or a list"),
    "nan": (edited("0.1]", ".nan]"), "line 11: weight: must not be nan"),
    "no-values": (edited("[1.0e-3, 0.1]", "[]"), "line 11: weight: is empty"),
    "forecast": (
        GRID + "forecast: perfekt\n",
        "line 14: forecast = 'perfekt': 'perfekt' must be one of perfect, persistence, errors, ens",
    ),
    "forecast-model": (GRID + "forecast: {size: 0.5}\n", "line 14: forecast: None must be one of"),
    "forecast-key": (
        GRID + "forecast: {model: errors, sise: 0.5}\n", "line 14: sise: is not known here; there"
    ),
    "forecast-option": (
        GRID + "forecast: {model: errors, members: 3}\n",
        "line 14: members: is not known here; there are model, size, seed",
    ),
    "forecast-size": (
        GRID + "forecast: {model: errors, size: [0.5, -1]}\n", "size: -1.0 must be from 0.0 to 10"
    ),
    "forecast-seed": (
        GRID + "forecast: {model: errors, seed: 1.5}\n", "seed = 1.5: must be a whole number, or"
    ),
    "forecast-members": (
        GRID + "forecast: {model: ensemble, members: [0]}\n", "members: 0 must be from 1 to 100"
    ),
    "forecast-file": (GRID + "forecast: absent.csv\n", "absent.csv: cannot be read: No such file"),
    "forecast-none": (GRID + "forecast: []\n", "line 14: forecast: is empty"),
    "forecast-twice": (
        GRID + "forecast: [errors, {model: errors, seed: 0}]\n", "forecast errors"
    ),
    "imperfections": (
        GRID + "imperfections: 0.0005\n", "line 14: imperfections = 0.0005: must be {roof_noise: "
    ),
    "imperfections-none": (
        GRID + "imperfections: []\n", "line 14: imperfections: must be {roof_noise: 0.0005, roof_o"
    ),
    "imperfections-key": (
        GRID + "imperfections: {noise: 0.1}\n", "line 14: noise: is not known here; there are roof"
    ),
    "imperfections-range": (
        GRID + "imperfections: {minimum_on: [60, -1]}\n", "minimum_on: -1.0 must be from 0.0 to 86"
    ),
    "imperfections-seed": (
        GRID + "imperfections: {noise_seed: 0.5}\n", "noise_seed = 0.5: must be a whole number"
    ),
    "imperfections-twice": (
        GRID + "imperfections: [{}, {roof_noise: 0}]\n", "forecast perfect, {'roof_noise': 0.0, "
    ),
    "twice": (edited("0.1]", "0.001]"), "is the same run twice: mpc {'weight': 0.001"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_grid(tmp_path: Path, name: str) -> None:
    """Exit code 2, one line that says where and what, before anything runs or is written."""
    text, expected = WRONG[name]
    result = study(tmp_path, grid(tmp_path, text), "--output", "out")
    assert result.returncode == 2, result.stderr
    assert expected in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["absent.yaml"], "absent.yaml: cannot be read"),
        (["--jobs", "0"], "argument --jobs: invalid whole number from 1 to 1024 value: '0'"),
        (["--engine", "gazebo"], "argument --engine: invalid choice: 'gazebo'"),
        (["--scheduler", "tcp://127.0.0.1:9", "--jobs", "2"], "--jobs: is not an option with"),
        (["--output", "/proc/study"], "--output = '/proc/study': cannot be written"),
    ],
)
def test_wrong_options(tmp_path: Path, options: list[str], expected: str) -> None:
    """Exit code 2, and no traceback."""
    result = study(tmp_path, *options)
    assert result.returncode == 2
    assert expected in result.stderr
    assert "Traceback" not in result.stderr


def test_what_was_begun_is_not_mixed_with_something_else(tmp_path: Path) -> None:
    """Another grid, another engine, other versions, a directory of something else."""
    small = edited("[published, fao56]", "published").replace("    weight: [1.0e-3, 0.1]\n", "")
    assert study(tmp_path, grid(tmp_path, small), "--output", "out").returncode == 0
    before = (tmp_path / "out" / "results.csv").read_bytes()

    def refusal(*options: str) -> str:
        result = study(tmp_path, "grid.yaml", "--output", "out", *options)
        assert result.returncode == 2
        assert result.stderr.count("\n") == 1
        return result.stderr

    assert "begun with another engine" in refusal("--engine", "ros")
    grid(tmp_path, small.replace("hours: 0.25", "hours: 0.5"))
    assert "begun with another grid, or other files" in refusal()
    grid(tmp_path, small)
    file = tmp_path / "out" / "configuration" / "study.json"
    file.write_text(file.read_text().replace('"osqp": "', '"osqp": "0.'))
    assert "begun with other versions" in refusal()
    file.write_text("{")
    assert "study.json: is not valid JSON" in refusal()
    assert (tmp_path / "out" / "results.csv").read_bytes() == before
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("42")
    result = study(tmp_path, "grid.yaml", "--output", "mine")
    assert result.returncode == 2
    assert "exists, is not empty and no study" in result.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_damaged_outcomes_are_made_again(tmp_path: Path) -> None:
    """As a power cut leaves them: empty, gone, something else."""
    name = grid(tmp_path)
    assert study(tmp_path, name, "--output", "out").returncode == 0
    table = tmp_path / "out" / "results.csv"
    before = table.read_bytes()
    runs = sorted((tmp_path / "out" / "runs").iterdir())
    (runs[0] / "outcome.json").write_text("")
    (runs[1] / "outcome.json").unlink()
    (runs[2] / "outcome.json").write_text("[1, 2]")
    (tmp_path / "out" / "bounds.json").write_text("{")
    result = study(tmp_path, name, "--output", "out")
    assert result.returncode == 0, result.stderr
    assert "9 of 12 runs are there already" in result.stderr
    assert table.read_bytes() == before


def test_bound_beside_each_run(papers: Path) -> None:
    """The least possible total from low-low is about 4,422 m3; no run is below its own."""
    rows = rows_of(papers / "results.csv")
    bounds = {row["initial"]: float(row["bound_m3"]) for row in rows}
    assert bounds["low-low"] == pytest.approx(4422, abs=1)
    for row in rows:
        ratio = float(row["total_deviation_m3"]) / bounds[row["initial"]]
        assert float(row["ratio_to_bound"]) == ratio
        assert ratio > 1 - 1e-9


def test_readme_shows_both_kinds_of_evapotranspiration(tmp_path: Path) -> None:
    """The README's table is what the grid beside it gives, to the digit shown."""
    result = study(tmp_path, str(CONFIG / "study_evapotranspiration.yaml"), "--output", "out")
    assert result.returncode == 0, result.stderr
    totals = {
        (
            row["controller"], float(row["weight"] or row["fraction"]), row["initial"],
            row["evapotranspiration"],
        ): float(row["total_deviation_m3"])
        for row in rows_of(tmp_path / "out" / "results.csv")
    }
    readme = (Path(__file__).resolve().parent.parent / "README.md").read_text()
    shown = re.findall(
        r"^\| (MPC|on/off) ([\d.]+) \| (\d+) \| (\d+) \| (\d+) \| (\d+) \|$", readme, re.MULTILINE
    )
    assert len(shown) == 10
    for controller, parameter, *figures in shown:
        name = {"MPC": "mpc", "on/off": "onoff"}[controller]
        expected = [
            f"{totals[name, float(parameter), initial, variant]:.0f}"
            for initial in ("low-low", "high-low") for variant in ("published", "fao56")
        ]
        assert figures == expected


@pytest.mark.parametrize("file", sorted(path.name for path in CONFIG.glob("study*.yaml")))
def test_grids_that_come_with_it(file: str) -> None:
    """Each can be run as it is."""
    assert read_grid(CONFIG / file)


def test_ros_in_a_domain_in_use(tmp_path: Path) -> None:
    """A graph runs in the domain that a run would take first: it takes another."""
    text = edited("[published, fao56]", "published").replace("0.25", "0.02")
    text = text.replace("    weight: [1.0e-3, 0.1]\n", "").replace("low-low, ", "")
    cases = read_grid(tmp_path / grid(tmp_path, text))
    domain = 1 + int(cases[0].identity, 16) % 101
    process = Process(
        domain, "bringup", "--hours", "0.12", "--speed", "20", "--output", "run", cwd=tmp_path
    )
    wait_for_ticks(tmp_path / "run")
    result = study(tmp_path, "grid.yaml", "--output", "out", "--engine", "ros")
    assert result.returncode == 0, result.stderr
    assert process.process.poll() is None, "the graph had ended; nothing was shown"
    assert process.wait(90) == 0
