"""The graph gives the in-process run's numbers bit for bit, loses nothing, ignores other graphs."""

from __future__ import annotations

import csv
import json
import struct
from pathlib import Path

import pytest
from commands import run_command
from graphs import bring_up, changed, environment, messages_of
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
OF_OTHER = {
    "/cistern/other_flow": "other_flow_m3_per_s", "/cistern/other_demand": "other_demand_m3_per_s",
}
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
    other = OF_OTHER if OF_OTHER["/cistern/other_flow"] in rows[0] else {}
    assert OF_OTHER.keys() & bag.keys() == other.keys()
    for topic, column in (COLUMNS | valve | other).items():
        if topic == "/roof/level" and "--roof-noise" in options:
            continue  # a reading of the sensor; the trajectory has the true level
        values = [message[4:12] for message in bag[topic]]
        assert values == [struct.pack("<d", float(row[column])) for row in rows], topic
    summary, inprocess = (
        json.loads((directory / run / "summary.json").read_text()) for run in ("run", "inprocess")
    )
    assert summary.keys() == inprocess.keys()
    differing = {key for key in summary if summary[key] != inprocess[key] and key not in OWN}
    assert not differing
    return rows


def test_same_bits_with_a_valve(domain: int, tmp_path: Path) -> None:
    """In ticks of a minute, with noise, other uses, and frost that closes the valve for an hour.

    It rained until an hour before the run, whose weather therefore is wet for another hour: the
    policies that drain open the valve in tick 60.
    """
    file = site_file(
        tmp_path, tau=60.0, valve_closed_in_frost=True, drainage_to_cistern=0.5,
        valve_moves_per_hour=4.0, other_demand=3000.0, **VALVE
    )
    packaged = shared_directory() / "config" / "weather" / "toronto_2021-07.csv"
    hour = "2021-07-07T21:00-05:00,0.0,1.58908930,"
    weather = changed(packaged.read_text(), f"{hour}17.5,15.0", f"{hour}-1.0,-1.0")
    (tmp_path / "weather.csv").write_text(weather)
    rows = same_bits(
        domain, tmp_path, "--controller", "lookahead", "--horizon", "24",
        "--forecast", "ensemble", "--forecast-seed", "3", "--forecast-members", "30",
        "--roof-noise", "0.002", "--noise-seed", "8", "--outlet-reach", "5", "--site", str(file),
        "--cistern", "70", "--roof", "2", "--weather", "weather.csv",
        "--start", "2021-07-07T11:00", "--hours", "14",
    )
    commands, flows = (
        [float(row[column]) for row in rows] for column in OF_VALVE.values()
    )
    assert set(commands[600:660]) == set(flows[600:660]) == {0.0}
    assert next(tick for tick, command in enumerate(commands) if command) == 60
    assert sum(flows) > 0
    plans = messages_of(tmp_path / "run")["/controller/plan"]
    assert len({len(plan) for plan in plans[600:660]}) == 1  # a row of NaN in frost
    assert len(plans[660]) > len(plans[600])
