"""The workers of a study, processes or an executor: the same table, and their ends."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import polars
import pytest
from graphs import alive, wait_for
from places import CHECKOUT, DATA, refusal
from studies import (
    WEATHER,
    archive,
    begun,
    edit_grid,
    grid,
    rows_of,
    store_of,
    stored,
    study,
)

import greenroof_ros as gr
from greenroof_ros.analysis.study import run_study


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


def test_a_script_without_its_guard(tmp_path: Path) -> None:
    """Workers import the script, which starts workers itself: the error names the guard."""
    script = tmp_path / "script.py"
    script.write_text(
        "import greenroof_ros as gr\ngr.study({'controller': 'mpc', 'hours': 0.01}, jobs=1)\n"
    )
    ended = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, cwd=tmp_path, timeout=100,
        check=False,
    )
    assert ended.returncode == 1
    assert "if __name__ == '__main__':" in ended.stderr.splitlines()[-1]


def processor_s(process: int) -> float:
    """Return the processor time of a process (s); 0 after it has ended."""
    try:
        ticks = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return int(ticks[11]) / os.sysconf("SC_CLK_TCK")


def workers(process: int) -> list[int]:
    """Return the processes that do a study's runs."""
    found = []
    for child in children(process):
        with suppress(OSError):
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(child)
    return found


def wait_for_end(processes: list[int]) -> None:
    """Wait until none of these processes runs any more."""
    wait_for(lambda: not any(map(alive, processes)), 60, f"the end of {processes}")


def lasting(hours: str) -> str:
    """Return the grid with six longer runs, and without bounds."""
    text = edit_grid("[published, fao56]", "fao56").replace("hours: 0.25", f"hours: {hours}")
    return f"{text}show: [pumped_m3]\n"


def test_a_killed_worker_ends_the_study(tmp_path: Path) -> None:
    """A sentence states this. One of the controllers is a user's own, from this directory."""
    (tmp_path / "mine.py").write_text((CHECKOUT / "examples" / "proportional.py").read_text())
    grid(tmp_path, lasting("1").replace("  onoff:\n", "  mine:Proportional:\n"))
    process = begun(tmp_path, "--jobs", "2")
    wait_for(lambda: stored(tmp_path), 120, "a finished run")
    os.kill(workers(process.pid)[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=300)
    done = len(stored(tmp_path))
    assert errors.splitlines()[-1].startswith("error: a worker was killed")
    assert process.returncode == 1
    assert "Traceback" not in errors
    status = [row["status"] for row in rows_of(tmp_path / "out" / "results.csv")]
    assert sorted(status) == ["done"] * done + ["not run"] * (6 - done)


def test_a_run_that_fails_is_named(tmp_path: Path) -> None:
    """In the table; the other runs are stored."""
    text = (CHECKOUT / "examples" / "proportional.py").read_text()
    first = "        if not cistern_level >= self._site.suction_level:\n"
    assert first in text
    (tmp_path / "mine.py").write_text(text.replace(first, f"        1 / 0\n{first}"))
    grid(tmp_path, lasting("0.01").replace("  onoff:\n", "  onoff:\n  mine:Proportional:\n"))
    result = study(tmp_path, "grid.yaml", "--output", "out", "--jobs", "2")
    assert result.returncode == 1
    rows = rows_of(tmp_path / "out" / "results.csv")
    status = {(row["controller"], row["status"]) for row in rows}
    assert status == {("mpc", "done"), ("onoff", "done"), ("proportional", "failed")}
    for row in rows:
        assert ("division by zero" in row["error"]) == (row["status"] == "failed")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_while_workers_start(tmp_path: Path, number: signal.Signals) -> None:
    """All processes get the signal, as from a terminal or a batch system, while one imports."""
    grid(tmp_path)
    process = begun(tmp_path)
    there = wait_for(lambda: workers(process.pid), 120, "a worker")
    # During its imports, which take half a second or more.
    wait_for(lambda: processor_s(there[0]) > 0.2, 60, "imports of a worker")
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    wait_for_end(there)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_ended(tmp_path: Path, number: signal.Signals) -> None:
    """Ctrl-C, or a signal only to the study's process: all others end with it, before their runs.

    Nothing is left behind, and the table states what was not run.
    """
    # Not in tmp_path: the path of the fork server's socket can have at most 107 characters.
    scratch = Path(tempfile.mkdtemp())
    # A month takes minutes.
    month = str(DATA / "en_climate_hourly_07-2021.csv")
    grid(tmp_path, lasting("500").replace(str(WEATHER), month))
    process = begun(tmp_path, "--jobs", "2", TMPDIR=str(scratch))

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
    _, errors = process.communicate(timeout=60)  # a run takes minutes
    wait_for_end(there)
    assert "Traceback" not in errors
    if number != signal.SIGKILL:
        assert process.returncode == 130
        assert "resource_tracker" not in errors
        assert {file.suffix for file in scratch.iterdir()} <= {".lock"}
        rows = rows_of(tmp_path / "out" / "results.csv")
        assert len(rows) == 6
        for row in rows:  # compiled runs can be done before the processes are busy
            assert row["status"] == "not run" or (row["controller"], row["status"]) == (
                "onoff", "done"
            )
    shutil.rmtree(scratch)


BY_BOTH = """
site: {file: site.yaml, a1: 26.0}  # no worker has this site as a file
weather: {file: weather.csv, start: 2021-07-07T00:50, hours: 0.2}
initial: low-low
controllers:
  mpc: {weight: 1.0e-3, forecast: archive.csv}
  lookahead: {forecast: {model: errors, seed: 1}}
  anticipating_onoff: {horizon: 12.0, forecast: {model: ensemble, members: 3}}
"""


def test_processes_and_a_cluster_give_the_same_table(tmp_path: Path) -> None:
    """Digit for digit, with trajectories and bounds, by workers of Dask that see the directory."""
    distributed = pytest.importorskip("distributed")
    archive(tmp_path)
    shutil.copy(WEATHER, tmp_path / "weather.csv")
    grid(tmp_path, BY_BOTH)
    here, there = (store_of(tmp_path, output=name) for name in ("here", "there"))
    run_study(here)
    here.write_table()
    with (
        distributed.LocalCluster(n_workers=1, host="127.0.0.1", dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        run_study(there, executor=client.get_executor(pure=False))
    there.write_table()
    results = {file.relative_to(here.directory) for file in here.directory.glob("runs/*/*.p*")} | {
        Path("results.csv"), Path("bounds.json")
    }
    assert len(results) == 5
    for name in results:
        assert (here.directory / name).read_bytes() == (there.directory / name).read_bytes()
    rows = rows_of(here.directory / "results.csv")
    assert len({row["final_roof_m3"] for row in rows}) == 3


def test_a_study_in_python(tmp_path: Path) -> None:
    """From a product, a list or a frame, by any executor; continued with what is stored."""
    product = {"controller": ["onoff", "mpc"], "hours": 0.05, "initial": ["low-low", "high-low"]}
    rows = [
        {"controller": controller, "hours": 0.05, "initial": initial}
        for controller in product["controller"] for initial in product["initial"]
    ]
    tables = [gr.study(product, output=tmp_path / "out")]
    with ThreadPoolExecutor(2) as executor:
        tables += [gr.study(cases, executor) for cases in (rows, polars.DataFrame(rows))]
    for table in tables:
        assert table.equals(tables[0])
        for row in table.to_dicts():
            single = gr.simulate(row["controller"], hours=0.05, initial=row["initial"]).metrics
            assert {name: row[name] for name in single} == single
    stored = {file: file.stat().st_mtime_ns for file in (tmp_path / "out" / "runs").glob("*/*")}
    assert gr.study(product, output=tmp_path / "out").equals(tables[0])
    assert stored == {file: file.stat().st_mtime_ns for file in stored}
    refusal(gr.study, [*rows, {"hours": -1}], match="hours = -1.*case 5")


def test_a_data_frame_of_weather_is_a_file_of_the_study(tmp_path: Path) -> None:
    weather = polars.DataFrame({
        "time": [f"2021-07-07T{hour:02}:00-05:00" for hour in range(24)],
        "precipitation [mm/h]": [float(hour % 3) for hour in range(24)],
        "my evapotranspiration [mm/day]": 24 * [4.0],
    })
    given = {"weather": weather, "start": "2021-07-07T05:00", "hours": 1.0}
    with ThreadPoolExecutor(1) as executor:
        table = gr.study({**given, "fraction": [0.5, 1.0]}, executor, output=tmp_path / "out")
    assert table["rain_m3"][0] == gr.simulate(**given).metrics["rain_m3"] > 0
    assert (tmp_path / "out" / "configuration" / "weather.csv").is_file()
