"""Studies by every engine: the same table, their workers and their ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from graphs import Process, alive, wait_for
from places import DATA
from studies import CONFIG, WEATHER, archive, begun, edited, grid, rows_of, run_here, stored, study

from greenroof_ros.recording.trajectory import read_parquet
from greenroof_ros.report.sources import find_runs
from greenroof_ros.study.grid import read_grid


def children(process: int) -> Iterator[int]:
    """Yield all processes under a process."""
    try:
        under = [
            int(child) for thread in Path(f"/proc/{process}/task").iterdir()
            for child in (thread / "children").read_text().split()
        ]
    except OSError:
        return  # it has just ended
    for child in under:
        yield child
        yield from children(child)


def processor_s(process: int) -> float:
    """Return the processor time of a process (s); 0 after it has ended."""
    try:
        ticks = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return int(ticks[11]) / os.sysconf("SC_CLK_TCK")


def fork_server(process: int) -> int:
    """Return the process that starts a study's workers; 0 if it does not run yet."""
    for child in children(process):
        with suppress(OSError):
            if b"forkserver" in Path(f"/proc/{child}/cmdline").read_bytes():
                return child
    return 0


def wait_for_end(processes: list[int]) -> None:
    """Wait until none of these processes runs any more."""
    wait_for(lambda: not any(map(alive, processes)), 60, f"the end of {processes}")


def lasting(hours: str) -> str:
    """Return the grid with six longer runs, and without bounds."""
    text = edited("[published, fao56]", "fao56").replace("hours: 0.25", f"hours: {hours}")
    return f"{text}bound_block: 0\n"


def test_a_killed_worker_fails_its_run_alone(tmp_path: Path) -> None:
    """The others continue; the failure is in the table; the next call repeats the run."""
    grid(tmp_path, lasting("3").replace("[low-low, ", "["))
    process = begun(tmp_path, "--jobs", "2")

    def worker() -> int:
        """Return a worker that is on a run; 0 if none is yet."""
        server = fork_server(process.pid)
        return next((child for child in children(server) if processor_s(child) > 0.5), 0)

    os.kill(wait_for(worker, 120, "a worker on a run"), signal.SIGKILL)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 1
    assert "failed: mpc" in errors
    assert "Traceback" not in errors
    rows = rows_of(tmp_path / "out" / "results.csv")
    (failed,) = [row for row in rows if row["status"] == "failed"]
    assert failed["error"]
    assert failed["total_deviation_m3"] == ""
    assert all(row["total_deviation_m3"] for row in rows if row["status"] == "done")
    result = study(tmp_path, "grid.yaml", "--output", "out")
    assert result.returncode == 0
    assert "2 of 3 runs are stored already" in result.stderr
    assert {row["status"] for row in rows_of(tmp_path / "out" / "results.csv")} == {"done"}


def test_interrupted_while_workers_start(tmp_path: Path) -> None:
    """Ctrl-C while the fork server imports: it prints no traceback."""
    grid(tmp_path)
    process = begun(tmp_path)
    server = wait_for(lambda: fork_server(process.pid), 120, "a fork server")
    # During its imports, which take half a second or more.
    wait_for(lambda: processor_s(server) > 0.2, 60, "imports of the fork server")
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    wait_for_end([server])


@pytest.mark.parametrize(
    ("engine", "number"),
    [("inprocess", signal.SIGINT), ("inprocess", signal.SIGTERM), ("ros", signal.SIGKILL)],
)
def test_ended(tmp_path: Path, engine: str, number: signal.Signals) -> None:
    """Ctrl-C, or a signal only to the study's process: all others end with it, before their runs.

    Nothing is left behind, and the table says what was not run.
    """
    # Not in tmp_path: the path of the fork server's socket can have at most 107 characters.
    scratch = Path(tempfile.mkdtemp())
    # A month takes minutes.
    month = str(DATA / "en_climate_hourly_07-2021.csv")
    grid(tmp_path, lasting("500").replace(str(WEATHER), month))
    process = begun(tmp_path, "--jobs", "2", "--engine", engine, TMPDIR=str(scratch))

    def under_way() -> bool:
        assert process.poll() is None
        busy = [child for child in children(process.pid) if processor_s(child) > 1]
        return len(busy) >= 2

    wait_for(under_way, 120, "two busy processes")
    there = list(children(process.pid))
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # as a terminal does
    else:
        process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    wait_for_end(there)
    assert "Traceback" not in errors
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert "resource_tracker" not in errors
        assert {file.suffix for file in scratch.iterdir()} <= {".lock"}
        status = [row["status"] for row in rows_of(tmp_path / "out" / "results.csv")]
        assert status == ["not run"] * 6
    shutil.rmtree(scratch)


PLANNED = f"""
site: {CONFIG / "site.yaml"}
weather: {{file: {WEATHER}, start: 2021-07-07T00:50, hours: 0.2}}
initial: low-low
"""
BY_BOTH = PLANNED + """
controllers:
  mpc: {weight: 1.0e-3, forecast: archive.csv}
  anticipating_onoff: {horizon: 12.0, forecast: {model: ensemble, members: 3}}
sensor_pump_errors:
  - {}
  - {roof_noise: 0.0005, roof_offset: 0.002, noise_seed: 1, minimum_on: 60, minimum_off: 90}
"""


def test_engines_give_the_same_table(tmp_path: Path) -> None:
    """Bit for bit: the loop in process, and real graphs, each in a separate domain.

    Both have forecasts from a file and an ensemble, and errors of sensor and pump. Another graph
    runs in the domain that the first run would use: it uses another one.
    """
    archive(tmp_path)
    loop, graph = tmp_path / "loop", tmp_path / "graph"
    cases = read_grid(tmp_path / grid(tmp_path, BY_BOTH))
    domain = 51 + int(cases[0].identity, 16) % 51
    process = Process(domain, "bringup", "--speed", "20", "--output", "run", cwd=tmp_path)
    process.wait_for_ticks(size=0)
    for output, engine in ((loop, "inprocess"), (graph, "ros")):
        result = study(tmp_path, "grid.yaml", "--output", output.name, "--engine", engine)
        assert result.returncode == 0, result.stderr
    assert process.process.poll() is None, process.stderr()
    process.process.send_signal(signal.SIGINT)
    assert process.wait(300) == 130

    assert (loop / "results.csv").read_bytes() == (graph / "results.csv").read_bytes()
    rows = rows_of(loop / "results.csv")
    names = ["roof_noise", "roof_offset", "noise_seed", "minimum_on", "minimum_off"]
    assert [[float(row[name]) for name in names] for row in rows] == [
        [0] * 5, [0.0005, 0.002, 1, 60, 90],
    ] * 2
    final = {(row["controller"], row["roof_offset"]): float(row["final_roof_m3"]) for row in rows}
    assert len(set(final.values())) == len(final) == 4
    assert len({row["bound_m3"] for row in rows}) == 1
    for row in rows:
        run = graph / "runs" / row["run"]
        assert (run / "bag" / "bag_0.mcap").is_file()
        true, replayed = (
            read_parquet(output / "runs" / row["run"] / "trajectory.parquet").roof
            for output in (loop, graph)
        )
        if row["roof_noise"] == "0.0":
            assert replayed == pytest.approx(true, rel=1e-12)
        else:
            assert replayed.tobytes() == true.tobytes()
    # Named equally on the page, for a bag with its summary and for a study.
    bags = [graph / "runs" / row["run"] for row in rows]
    labels = [
        [run.row["forecast"] for run in find_runs(paths, None).runs] for paths in (bags, [loop])
    ]
    assert labels[0] == labels[1]
    assert set(labels[0]) == {"archive.csv", "ensemble skill real seed 0 members 3"}


FORECASTS = """
controllers: {anticipating_onoff: {horizon: 12.0}}
forecast: [perfect, {model: errors, skill: [worse, mine.yaml], seed: 1}, archive.csv]
"""


def test_forecasts(tmp_path: Path) -> None:
    """Each run names its own, and depends on what their files contain."""
    archive(tmp_path)
    # A user's skill: the package's, but it rains too seldom.
    skill = (CONFIG / "forecasts" / "skill.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(skill.replace("wetness:", "wetness: -1.0 #"))
    rows = run_here(tmp_path, PLANNED + FORECASTS).write_tables()
    columns = ("forecast", "forecast_skill", "forecast_seed")
    assert [tuple(row[column] for column in columns) for row in rows] == [
        ("perfect", None, None), ("errors", "worse", 1), ("errors", "mine.yaml", 1),
        ("archive.csv", None, None),
    ]
    # Only the file forecasts rain, so less is pumped.
    pumped = [row["pumped_m3"] for row in rows]
    assert pumped[3] < min(pumped[:3])
    for number, file, old, new in ((3, "archive.csv", "4.0", "5.0"), (2, "mine.yaml", "45", "46")):
        before = [case.identity for case in read_grid(tmp_path / "grid.yaml")]
        (tmp_path / file).write_text((tmp_path / file).read_text().replace(old, new))
        after = [case.identity for case in read_grid(tmp_path / "grid.yaml")]
        assert [place for place in range(4) if before[place] != after[place]] == [number]


class Dask:
    """A Dask scheduler and its workers, each a separate process, on loopback."""

    def __init__(self, directory: Path) -> None:
        file, self.log = directory / "scheduler.json", directory / "dask.log"
        self.workers: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start(
            "scheduler", "--port", "0", "--no-show", "--scheduler-file", str(file)
        )
        wait_for(lambda: file.is_file() and file.read_text().endswith("}"), 60, "a scheduler")
        self.address = json.loads(file.read_text())["address"]

    def start_worker(self) -> None:
        """Start another worker."""
        self.workers.append(
            self._start("worker", self.address, "--nthreads", "1", "--no-nanny")
        )

    def _start(self, what: str, *options: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{what}", *options,
             "--host", "127.0.0.1", "--dashboard-address", ":0"],
            stdout=self.log.open("a"), stderr=subprocess.STDOUT,
        )

    def wait_for_log(self, words: str, times: int = 1) -> None:
        """Wait until the log has these words so many times."""
        wait_for(lambda: self.log.read_text().count(words) >= times, 60, f"{words!r} in a log")


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    """A scheduler without workers, which is ended with all that it got."""
    started = Dask(tmp_path)
    yield started
    for process in (*started.workers, started.scheduler):
        process.kill()
        process.wait()


def test_dask(dask: Dask, tmp_path: Path) -> None:
    """A study loses a worker, the other, and the scheduler; in the end its table is complete.

    The second worker continues, and repeats only what the first had under way. Without workers
    for a while, or without scheduler, the study says so in one sentence; Ctrl-C before that
    interrupts it at once. Without a worker or an answer it does not begin. The same command
    without a cluster continues; no run is made twice, and none differs.
    """
    archive(tmp_path)
    text = edited("0.25", "0.5").replace("02:00", "01:00").replace("  onoff:\n", "")
    text = text.replace("[1.0e-3, 0.1]", "[1.0e-3, 0.01, 0.1]")
    site = "{file: site.yaml, a1: 26.0}"  # no worker has this site as a file
    grid(tmp_path, text.replace(str(CONFIG / "site.yaml"), site) + "forecast: archive.csv\n")
    on_cluster = ("--scheduler", dask.address)

    def wait_for_runs(process: subprocess.Popen[str], count: int) -> None:
        due = len(stored(tmp_path)) + count

        def under_way() -> bool:
            assert process.poll() is None, process.communicate()
            return len(stored(tmp_path)) >= due

        wait_for(under_way, 120, f"{count} runs more")

    def check_end(process: subprocess.Popen[str], what: str) -> None:
        shown, errors = process.communicate(timeout=60)
        *_, bar, said = errors.splitlines()
        done = len(stored(tmp_path))
        assert bar.startswith("study ") and "Traceback" not in errors
        assert said == (
            f"error: {what}: {done} of 12 cases are stored; run the same command again to continue"
        )
        assert (process.returncode, shown) == (1, "")
        status = [row["status"] for row in rows_of(tmp_path / "out" / "results.csv")]
        assert sorted(status) == ["done"] * done + ["not run"] * (12 - done)

    def check_refusal(wrong: str) -> None:
        result = study(tmp_path, "grid.yaml", "--output", "out", *on_cluster)
        assert result.returncode == 2
        assert f"error: --scheduler = '{dask.address}': {wrong}" in result.stderr
        assert "Traceback" not in result.stderr

    dask.start_worker()
    dask.start_worker()
    process = begun(tmp_path, *on_cluster)
    wait_for_runs(process, 2)
    dask.workers[0].kill()
    dask.wait_for_log("Remove worker")
    wait_for_runs(process, 2)
    # Stored runs are not repeated, except the last run, which the study may still hold.
    lost = [line for line in dask.log.read_text().splitlines() if "lose already computed" in line]
    assert sum(line.count("run_case") for line in lost) <= 1
    dask.workers[1].kill()
    check_end(process, f"the Dask scheduler at {dask.address} has had no worker for 15 s")
    process = begun(tmp_path, *on_cluster)
    dask.wait_for_log("Receive client connection", 2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors.splitlines()[1:]) == (130, ["interrupted"])
    check_refusal("has no worker")
    dask.start_worker()
    process = begun(tmp_path, *on_cluster)
    wait_for_runs(process, 1)
    dask.scheduler.kill()
    check_end(process, f"the Dask scheduler at {dask.address} is gone")
    dask.scheduler.wait()
    check_refusal("does not answer")
    before = {run: (run / "outcome.json").read_bytes() for run in stored(tmp_path)}
    for output in ("out", "here"):
        assert study(tmp_path, "grid.yaml", "--output", output).returncode == 0
    here, there = (tmp_path / name / "results.csv" for name in ("here", "out"))
    assert here.read_bytes() == there.read_bytes()
    assert {row["status"] for row in rows_of(there)} == {"done"}
    for run, outcome in before.items():
        assert (run / "outcome.json").read_bytes() == outcome
