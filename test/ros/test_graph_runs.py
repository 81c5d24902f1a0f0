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
# What the two runs may differ in.
OWN = ("wall_s", "times_real_time", "solver", "messages", "versions")


def same_bits(domain: int, directory: Path, *options: str) -> list[dict[str, str]]:
    """Run the graph, and the same in one process; return the rows of the latter's trajectory.

    The bag must have each bit of the trajectory, and the summary each figure of the other one.
    """
    bring_up(domain, directory, *options)
    done = run_command(
        "simulate", *options, "--trajectory", "--output", "inprocess", cwd=directory,
        env=environment(domain),
    )
    assert done.returncode == 0, done.stderr
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
    assert summary.keys() == inprocess.keys()
    differing = {key for key in summary if summary[key] != inprocess[key] and key not in OWN}
    assert not differing
    return rows


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
    rows = same_bits(domain, tmp_path, *options)
    assert float(rows[0]["drainage_layer_m3"]) == 0.3
    summary = summary_of(tmp_path / "run")
    assert {len(rows)} == set(summary["messages"].values())
    assert summary["outflow_m3"] > 3 and summary["rain_cistern_m3"] > 0.01
    assert summary["pumped_m3"] > 0


def with_frost(directory: Path, hour: str) -> str:
    """Write the paper's weather with frost in an hour, and return the file's name."""
    packaged = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
    lines = [line for line in packaged.read_text().splitlines() if not line.startswith("#")]
    rows = [dict(row) for row in csv.DictReader(lines)]
    file = directory / "weather.csv"
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        for row in rows:
            if next(iter(row.values())).startswith(hour):
                row |= {"temperature [degC]": "-1.0", "dew point [degC]": "-1.0"}
            writer.writerow(row)
    return str(file)


def test_same_bits_and_plans_of_an_ensemble(domain: int, tmp_path: Path) -> None:
    """With sensor noise that affects the commands; the frost ends with a new issue."""
    same_bits(
        domain, tmp_path, "--controller", "lookahead", "--horizon", "12", "--forecast", "ensemble",
        "--forecast-seed", "3", "--forecast-members", "30",
        "--weather", with_frost(tmp_path, "2021-07-07T18:00"), "--start", "2021-07-07T18:58",
        "--hours", "0.05", "--roof-noise", "0.002", "--noise-seed", "8",
    )
    plans = messages_of(tmp_path / "run")["/controller/plan"]
    assert len({len(plan) for plan in plans[:120]}) == 1  # a row of NaN in frost
    assert len(plans) == 181 and len(plans[120]) > len(plans[0])


OPENS = """
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


@pytest.mark.parametrize(("controller", "opened"), [
    ("lookahead --horizon 24 --forecast ensemble --outlet-reach 5", 60), ("opens:Opens", 0),
])
def test_same_bits_with_a_valve(
    domain: int, tmp_path: Path, controller: str, opened: int
) -> None:
    """In ticks of a minute, with frost that closes the valve for an hour, whatever commands it.

    It rained until an hour before the run, whose weather therefore is wet for another hour: the
    policies that drain open the valve in tick 60.
    """
    file = site_file(
        tmp_path, tau=60.0, valve_closed_in_frost=True, drainage_to_cistern=0.5, **VALVE
    )
    (tmp_path / "opens.py").write_text(OPENS)
    rows = same_bits(
        domain, tmp_path, "--controller", *controller.split(), "--site", str(file),
        "--cistern", "70", "--roof", "2", "--weather", with_frost(tmp_path, "2021-07-07T21:00"),
        "--start", "2021-07-07T11:00", "--hours", "14",
    )
    commands, flows = (
        [float(row[column]) for row in rows] for column in OF_VALVE.values()
    )
    assert set(commands[600:660]) == set(flows[600:660]) == {0.0}
    assert next(tick for tick, command in enumerate(commands) if command) == opened
    assert sum(flows) > 0


def test_two_at_once(domain: int, tmp_path: Path) -> None:
    """Each in its namespace, with its parameters."""
    sites = {"site1": ("mpc", "weight: 0.02"), "site2": ("onoff", "fraction: 0.4")}
    together = {}
    for site, (controller, parameter) in sites.items():
        text = f"/**/{controller}:\n  ros__parameters:\n    {parameter}\n"
        (tmp_path / f"{site}.yaml").write_text(text)
        together[site] = Process(
            domain, "bringup", "--output", site, "--namespace", site, "--controller", controller,
            "--parameters", f"{site}.yaml", "--hours", "0.05", cwd=tmp_path,
        )
    for (site, process), topics in zip(together.items(), (MPC_TOPICS, bag_topics()), strict=True):
        assert process.wait(120) == 0, process.stderr()
        assert messages_of(tmp_path / site).keys() == {f"/{site}{topic}" for topic in topics}
    assert summary_of(tmp_path / "site1")["parameters"]["weight"] == 0.02
    # The file took effect in the node: on/off commands its fraction, and nothing else.
    assert summary_of(tmp_path / "site2")["max_command"] == 0.4
