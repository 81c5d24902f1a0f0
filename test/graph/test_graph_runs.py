"""The graph gives the in-process run's numbers bit for bit, loses nothing, and minds no other."""

from __future__ import annotations

import csv
import json
import os
import signal
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
from bag_topics import MPC_TOPICS, bag_topics
from commands import run_command
from graphs import (
    Process,
    bag_file,
    bring_up,
    environment,
    messages_of,
    summary_of,
    wait_for,
)
from paper import paper_run, site_file

from greenroof_ros.common.files import shared_directory
from greenroof_ros.common.interface import read_topics
from greenroof_ros.controllers.lookahead import Lookahead
from greenroof_ros.experiment.closed_loop import closed_loop
from greenroof_ros.model.metrics import Metrics

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from greenroof_ros.graph.messages import encoder

COLUMNS = {
    "/cistern/level": "cistern_level_m",
    "/roof/level": "roof_level_m",
    "/weather/precipitation": "precipitation_m_per_s",
    "/weather/evapotranspiration": "evapotranspiration_m3_per_s",
    "/weather/frost": "frost",
    "/pump/command": "command",
    "/pump/flow": "pump_flow_m3_per_s",
    "/cistern/outflow": "outflow_m3_per_s",
    "/roof/drainage": "drainage_m3_per_s",
}


def assert_same(directory: Path) -> list[dict[str, str]]:
    """The bag in run/ has each bit of run.csv, and its summary each figure of inprocess/'s.

    Returns:
        The rows of run.csv.
    """
    with (directory / "run.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    bag = messages_of(directory / "run")
    for topic, column in COLUMNS.items():
        values = [message[4:12] for message in bag[topic]]
        assert values == [struct.pack("<d", float(row[column])) for row in rows], topic
    summary, inprocess = (
        json.loads((directory / run / "summary.json").read_text()) for run in ("run", "inprocess")
    )
    differing = {
        key
        for key in summary
        if summary[key] != inprocess[key]
        and key not in ("wall_s", "times_real_time", "solver", "messages", "versions")
    }
    assert not differing
    assert summary.keys() == inprocess.keys()
    return rows


def assert_same_plans(directory: Path, options: Sequence[str]) -> list[int]:
    """The bag in run/ has each byte of the plans that its controller makes in this process.

    Returns:
        How many rows each tick's message has.
    """
    run = paper_run(*options)
    controller = run.make_controller()
    assert isinstance(controller, Lookahead)
    topic = read_topics()["/controller/plan"]
    encode = encoder(topic.type, topic.dimensions)
    plans = [(encode(controller.plan), len(controller.plan))
             for _ in closed_loop(run, controller, Metrics())]
    assert messages_of(directory / "run")[topic.name] == [plan for plan, _ in plans]
    return [rows for _, rows in plans]


def test_same_bits_and_plans_of_an_ensemble(domain: int, tmp_path: Path) -> None:
    """Of lookahead, over a new issue, with noise of the sensor in its small commands."""
    options = (
        "--controller", "lookahead", "--horizon", "12", "--forecast", "ensemble",
        "--forecast-seed", "3", "--forecast-members", "30", "--start", "2021-07-07T18:58",
        "--hours", "0.05", "--roof-noise", "0.002",
    )
    bring_up(domain, tmp_path, *options)
    simulate(domain, tmp_path, *options)
    assert_same(tmp_path)
    rows = assert_same_plans(tmp_path, options)
    assert len(rows) == 181
    assert set(rows) == {0, 10}
    assert rows.count(10) > 1


def simulate(domain: int, directory: Path, *options: str) -> None:
    """Do the run in one process; it leaves ``run.csv``."""
    done = run_command(
        "simulate", *options, "--trajectory", "run.csv", "--output", "inprocess", cwd=directory,
        env=environment(domain),
    )
    assert done.returncode == 0, done.stderr


# How long, and when, of runs that differ in controller and site; of two more below.
WET = ("--start", "2021-07-08T08:57", "--hours", "0.1")
RUNS: dict[str, tuple[str, ...]] = {
    "mpc": (),
    "anticipating_onoff": ("--hours", "0.1"),
    "mpc wet": WET,
    "lookahead wet": (*WET, "--horizon", "240"),
}


@pytest.mark.parametrize("case", RUNS)
def test_same_bits_as_simulate(domain: int, tmp_path: Path, case: str) -> None:
    """Graph and simulate: equal in every bit of every value; twelve hours of the paper's MPC.

    Simulated they are those of the authors' published code: see test_fidelity.py.

    The wet site has a drainage layer and its own initial state, and a catchment of which a part
    arrives in a cistern that drains by itself.
    """
    controller, wet, _ = case.partition(" wet")
    options = ["--controller", controller, *RUNS[case]]
    if wet:
        file = site_file(
            tmp_path, base="site_neubrandenburg.yaml", a_in=100.0, runoff_coefficient=0.9,
            low_outlet_level=1.0, low_outlet_radius=0.05, initial_cistern=61.0, initial_roof=0.5,
            initial_layer=0.3,
        )
        options += ["--site", str(file)]
    summary = bring_up(domain, tmp_path, *options)
    simulate(domain, tmp_path, *options)
    rows = assert_same(tmp_path)
    assert {len(rows)} == set(summary["messages"].values())
    if wet:
        assert summary["initial"] == {
            "name": "site", "cistern_m3": 61.0, "roof_m3": 0.5, "layer_m3": 0.3,
        }
        assert float(rows[0]["drainage_layer_m3"]) == 0.3
        assert float(rows[0]["drainage_m3_per_s"]) > 1e-4
        assert float(rows[-1]["drainage_layer_m3"]) == summary["final_layer_m3"] > 0
        assert summary["outflow_m3"] > 3 and summary["rain_cistern_m3"] > 0.01
        assert summary["pumped_m3"] > 0


@pytest.mark.parametrize(
    "controller", ["--controller onoff --fraction 0.1", "--controller lookahead --horizon 12"]
)
def test_same_bits_on_an_imperfect_site(domain: int, tmp_path: Path, controller: str) -> None:
    """A sensor with noise and offset, pumps with minimum times, and frost that stops them."""
    packaged = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
    lines = [line for line in packaged.read_text().splitlines() if not line.startswith("#")]
    columns = lines[0].split(",")
    for index, line in enumerate(lines):
        if line.startswith("2021-07-07T03:00"):
            cells = line.split(",")
            cells[columns.index("temperature [degC]")] = "-1.0"
            cells[columns.index("dew point [degC]")] = "-1.0"
            lines[index] = ",".join(cells)
    (tmp_path / "weather.csv").write_text("\n".join(lines) + "\n")
    words = [
        *controller.split(), "--weather", str(tmp_path / "weather.csv"),
        "--start", "2021-07-07T02:59",
        "--hours", "0.05", "--roof-noise", "0.0005", "--roof-offset=-1e-3", "--noise-seed", "8",
        "--minimum-on", "50", "--minimum-off", "20",
    ]
    bring_up(domain, tmp_path, *words)
    simulate(domain, tmp_path, *words)
    rows = assert_same(tmp_path)
    assert len(rows) == 181
    flows = [float(row["pump_flow_m3_per_s"]) for row in rows]
    assert max(flows[:60]) > 0 and max(flows[60:]) == 0  # it freezes from 03:00 on
    if "onoff" in controller:
        assert flows[59] > 0
    else:
        plans = assert_same_plans(tmp_path, words)
        assert (plans[0], set(plans[60:])) == (32, {1})  # a row of NaN in frost
    errors = [float(row["roof_level_m"]) - float(row["roof_m3"]) / 68.8 for row in rows]
    assert sum(errors) / 181 == pytest.approx(-1e-3, abs=2e-4)


def test_starts_in_a_row_lose_nothing(domain: int, tmp_path: Path) -> None:
    """Six cold starts: complete, as ``bring_up`` holds every good run to be, and equal in bytes."""
    bags = set()
    for number in range(6):
        output = f"run-{number}"
        bring_up(domain, tmp_path, "--hours", "0.03", output=output)
        bags.add(bag_file(tmp_path / output).read_bytes())
    assert len(bags) == 1


# --- side by side, each in a namespace of its own -------------------------------------------------

# Of each its controller, a parameter, and its topics.
SITES = {
    "site1": ("mpc", "weight: 0.02", MPC_TOPICS), "site2": ("onoff", "fraction: 0.4", bag_topics()),
}


def options(cwd: Path, site: str) -> tuple[str, ...]:
    """Return a site's options; its parameter file, which holds in its namespace, is written."""
    controller, parameter, _ = SITES[site]
    (cwd / f"{site}.yaml").write_text(
        f"/**/{controller}:\n  ros__parameters:\n    {parameter}\n"
    )
    return ("--namespace", site, "--controller", controller, "--parameters", f"{site}.yaml",
            "--hours", "0.1")


def test_two_at_once(domain: int, tmp_path: Path) -> None:
    """Their bags have each byte of those of runs alone, and names in their namespace.

    So they have beside a third, of which a node is killed: its run ends.
    """
    killed = Process(
        domain, "bringup", "--output", "run", "--namespace", "site3", "--speed", "20", cwd=tmp_path
    )
    killed.wait_for_ticks(size=0)
    together = {
        site: Process(
            domain, "bringup", "--output", f"{site}-together", *options(tmp_path, site),
            cwd=tmp_path,
        )
        for site in SITES
    }
    file = bag_file(tmp_path / "site2-together")
    wait_for(lambda: file.exists() and file.stat().st_size > 10_000, 60, "a bag")
    os.kill(killed.nodes()["weather"], signal.SIGKILL)
    assert killed.wait(300) == 1
    assert "node weather ended (SIGKILL)" in killed.stderr()
    for process in together.values():
        assert process.wait(120) == 0, process.stderr()
    for site, (_, _, topics) in SITES.items():
        bring_up(domain, tmp_path, *options(tmp_path, site), output=f"{site}-alone")
        alone, beside = tmp_path / f"{site}-alone", tmp_path / f"{site}-together"
        assert bag_file(beside).read_bytes() == bag_file(alone).read_bytes()
        metadata = Path("bag") / "metadata.yaml"
        assert (beside / metadata).read_bytes() == (alone / metadata).read_bytes()
        assert messages_of(beside).keys() == {f"/{site}{topic}" for topic in topics}
    assert summary_of(tmp_path / "site1-together")["parameters"]["weight"] == 0.02
    # The file took effect in the node: on/off commands its fraction, and nothing else.
    assert summary_of(tmp_path / "site2-together")["max_command"] == 0.4
    # What is recorded under a namespace is recovered under it.
    done = run_command(
        "recover", "site1-alone", "--output", str(tmp_path / "again" / "bag"), cwd=tmp_path,
        env=environment(domain),
    )
    assert done.returncode == 0, done.stderr
    assert bag_file(tmp_path / "again").read_bytes() == (
        bag_file(tmp_path / "site1-alone").read_bytes()
    )
