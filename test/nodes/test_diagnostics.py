"""A run as ROS tools see it: its reports, its parameters, and two who command its pump."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from graphs import Process, summary_of
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from ros_rig import OK, Observer, check_diagnostics, qos
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

START = 1_625_641_200  # 2021-07-07T02:00-05:00 in seconds since 1970


def weights(*values: float) -> list[Any]:
    """Return values of mpc's weight, as messages."""
    return [Parameter("weight", value=value).to_parameter_msg() for value in values]


def test_simulated_run(domain: int, tmp_path: Path, observer: Observer) -> None:
    """All nodes are OK while it runs, and report the numbers that a watcher needs.

    The graph is in a namespace; a foreign clock on /clock, a day later, is ignored. Its parameter
    file has ``/**:`` and a whole number, as most files do: the node converts it to a double. The
    weight can be set during the run, wrong values are refused; a second master ends it.
    """
    names = [f"/site1/{name}" for name in ("plant", "weather", "mpc", "recorder")]
    (tmp_path / "mine.yaml").write_text("/**:\n  ros__parameters:\n    weight: 5\n")
    arrays = observer.collect("/diagnostics", lambda message: message)
    intruder, message = observer.publisher("/clock"), Clock()
    message.clock.sec = START + 86_400
    process = Process(
        domain, "bringup", "--controller", "mpc", "--output", "run", "--namespace", "site1",
        "--speed", "10", "--parameters", "mine.yaml", cwd=tmp_path,
    )

    def under_way() -> bool:
        intruder.publish(message)
        return bool(observer.values("/site1/plant").get("tick", 0) >= 40)

    observer.until(under_way, 120, "40 ticks")
    check_diagnostics(arrays)
    assert observer.diagnoses.keys() == set(names)
    assert {status.level for array in arrays for status in array.status} == {OK}
    plant, run = observer.values("/site1/plant"), tmp_path / "run"
    assert isinstance(plant["roof_level"], float)
    assert observer.values(names[3])["bag"] == str(run / "bag")
    (weight,) = observer.call(
        GetParameters, "/site1/mpc/get_parameters", names=["weight"]
    ).values
    assert (weight.type, weight.double_value) == (ParameterType.PARAMETER_DOUBLE, 5.0)
    set_parameters = SetParameters, "/site1/mpc/set_parameters"
    refused = observer.call(*set_parameters, parameters=weights(-1.0, math.nan))
    assert not any(result.successful or "weight" not in result.reason for result in refused.results)
    accepted = observer.call(*set_parameters, parameters=weights(6.0, 7.0))
    assert all(result.successful for result in accepted.results)
    observer.node.create_publisher(Float64, "/site1/pump/command", qos("/pump/command"))
    observer.until(lambda: process.process.poll() is not None, 60, "the end of the run")
    assert process.wait(300) == 1 and "Traceback" not in process.stderr()
    # A failed run's summary has all that is known, with the node's message.
    summary = summary_of(run)
    for text in (process.stderr(), summary["reason"]):
        assert "/site1/pump/command has 2 publishers (mpc, observer)" in text
    assert summary["parameter_change_count"] == 2
    last = summary["parameter_changes"][-1]
    assert (last["parameter"], last["before"], repr(last["value"])) == ("weight", 6.0, "7.0")
    assert 40 <= last["tick"] <= summary["last_tick"]
