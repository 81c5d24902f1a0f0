"""The graph gives the in-process run's numbers bit for bit, loses nothing, ignores other graphs."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import pytest
from bag_topics import MPC_TOPICS, bag_topics
from commands import run_command
from graphs import Process, bring_up, environment, messages_of, summary_of
from paper import VALVE, site_file

from greenroof_ros.base.files import shared_directory

pytest.importorskip("rclpy", reason="the graph needs ROS 2")


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
OF_VALVE = {"/outlet/command": "outlet_command", "/outlet/flow": "low_outlet_flow_m3_per_s"}


def assert_same(directory: Path) -> list[dict[str, str]]:
    """The bag in run/ has each bit of inprocess/, and its summary has each figure of inprocess/'s.

    Returns:
        The rows of the trajectory.
    """
    with (directory / "inprocess" / "trajectory.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    bag = messages_of(directory / "run")
    valve = OF_VALVE if "outlet_command" in rows[0] else {}
    assert OF_VALVE.keys() & bag.keys() == valve.keys()
    for topic, column in (COLUMNS | valve).items():
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


def simulate(domain: int, directory: Path, *options: str) -> None:
    """Do the run in one process; it writes ``inprocess/``."""
    done = run_command(
        "simulate", *options, "--trajectory", "--output", "inprocess", cwd=directory,
        env=environment(domain),
    )
    assert done.returncode == 0, done.stderr


def test_same_bits_at_a_wet_site(domain: int, tmp_path: Path) -> None:
    """Graph and simulate are equal in every bit of every value, across a change of the hour.

    In simulation they agree with the authors' published code: see test_fidelity.py.

    The site has a drainage layer, its own initial state, and a catchment with a runoff coefficient
    below 1; a low outlet drains the cistern.
    """
    file = site_file(
        tmp_path, base="site_neubrandenburg.yaml", a_in=100.0, runoff_coefficient=0.9,
        low_outlet_level=1.0, low_outlet_radius=0.05, initial_cistern=61.0, initial_roof=0.5,
        initial_layer=0.3,
    )
    options = ("--start", "2021-07-08T08:57", "--hours", "0.3", "--site", str(file))
    summary = bring_up(domain, tmp_path, *options)
    simulate(domain, tmp_path, *options)
    rows = assert_same(tmp_path)
    assert {len(rows)} == set(summary["messages"].values())
    assert summary["initial"] == {
        "name": "site", "cistern_m3": 61.0, "roof_m3": 0.5, "layer_m3": 0.3,
    }
    assert float(rows[0]["drainage_layer_m3"]) == 0.3
    assert float(rows[0]["drainage_m3_per_s"]) > 1e-4
    assert float(rows[-1]["drainage_layer_m3"]) == summary["final_layer_m3"] > 0
    assert summary["outflow_m3"] > 3 and summary["rain_cistern_m3"] > 0.01
    assert summary["pumped_m3"] > 0


def with_frost(directory: Path, hour: str) -> str:
    """Write the paper's weather with frost in an hour, and return the file's name."""
    packaged = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
    lines = [line for line in packaged.read_text().splitlines() if not line.startswith("#")]
    columns = lines[0].split(",")
    for index, line in enumerate(lines):
        if line.startswith(hour):
            cells = line.split(",")
            cells[columns.index("temperature [degC]")] = "-1.0"
            cells[columns.index("dew point [degC]")] = "-1.0"
            lines[index] = ",".join(cells)
    file = directory / "weather.csv"
    file.write_text("\n".join(lines) + "\n")
    return str(file)


def test_same_bits_and_plans_of_an_ensemble(domain: int, tmp_path: Path) -> None:
    """With sensor noise that affects the commands; the frost ends with a new issue."""
    options = (
        "--controller", "lookahead", "--horizon", "12", "--forecast", "ensemble",
        "--forecast-seed", "3", "--forecast-members", "30",
        "--weather", with_frost(tmp_path, "2021-07-07T18:00"), "--start", "2021-07-07T18:58",
        "--hours", "0.05", "--roof-noise", "0.002", "--noise-seed", "8",
    )
    bring_up(domain, tmp_path, *options)
    simulate(domain, tmp_path, *options)
    assert_same(tmp_path)
    plans = messages_of(tmp_path / "run")["/controller/plan"]
    assert len({len(plan) for plan in plans[:120]}) == 1  # a row of NaN in frost
    assert len(plans) == 181 and len(plans[120]) > len(plans[0])


OWN = """
class Opens:
    parameters, needs_forecast, outlet = (), False, 0.25

    def __init__(self, site):
        self._site = site

    def command(self, cistern_level, roof_level, precipitation, evapotranspiration):
        self.outlet = min(1.0, max(0.0, cistern_level - 2.2))
        return 0.3 if roof_level < self._site.z_veg else 0.0

    def skip(self):
        self.outlet = 0.125

    def statistics(self):
        return None
"""


@pytest.mark.parametrize(("controller", "options", "opened"), [
    ("onoff", ("--outlet-reserve", "50"), 60),
    ("lookahead", ("--horizon", "24", "--forecast", "ensemble", "--outlet-reach", "5"), 60),
    ("opens:Opens", (), 0),
])
def test_same_bits_with_a_valve(
    domain: int, tmp_path: Path, controller: str, options: tuple[str, ...], opened: int
) -> None:
    """In ticks of a minute, with frost that closes the valve for an hour, whatever commands it.

    It rained until an hour before the run, whose weather therefore is wet for another hour: the
    policies that drain open the valve in tick 60.
    """
    file = site_file(
        tmp_path, tau=60.0, valve_closed_in_frost=True, drainage_to_cistern=0.5, **VALVE
    )
    (tmp_path / "opens.py").write_text(OWN)
    options = (
        "--controller", controller, *options, "--site", str(file), "--cistern", "70", "--roof", "2",
        "--weather", with_frost(tmp_path, "2021-07-07T21:00"), "--start", "2021-07-07T11:00",
        "--hours", "14",
    )
    bring_up(domain, tmp_path, *options)
    simulate(domain, tmp_path, *options)
    rows = assert_same(tmp_path)
    commands, flows = (
        [float(row[column]) for row in rows] for column in OF_VALVE.values()
    )
    assert set(commands[600:660]) == set(flows[600:660]) == {0.0}
    assert next(tick for tick, command in enumerate(commands) if command) == opened
    assert sum(flows) > 0
    assert all(command > 0 for command, flow in zip(commands, flows, strict=True) if flow > 0)


# --- side by side, each in a separate namespace ---------------------------------------------------


def test_two_at_once(domain: int, tmp_path: Path) -> None:
    """Each in its namespace, with its parameters."""

    def options(site: str, controller: str, parameter: str) -> tuple[str, ...]:
        (tmp_path / f"{site}.yaml").write_text(
            f"/**/{controller}:\n  ros__parameters:\n    {parameter}\n"
        )
        return ("--namespace", site, "--controller", controller, "--parameters", f"{site}.yaml",
                "--hours", "0.05")

    sites = {
        "site1": options("site1", "mpc", "weight: 0.02"),
        "site2": options("site2", "onoff", "fraction: 0.4"),
    }
    together = {
        site: Process(domain, "bringup", "--output", site, *options, cwd=tmp_path)
        for site, options in sites.items()
    }
    for process in together.values():
        assert process.wait(120) == 0, process.stderr()
    for site, topics in (("site1", MPC_TOPICS), ("site2", bag_topics())):
        assert messages_of(tmp_path / site).keys() == {f"/{site}{topic}" for topic in topics}
    assert summary_of(tmp_path / "site1")["parameters"]["weight"] == 0.02
    # The file took effect in the node: on/off commands its fraction, and nothing else.
    assert summary_of(tmp_path / "site2")["max_command"] == 0.4
