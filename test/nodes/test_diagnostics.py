"""/diagnostics as ROS tools read it: names, hardware, stamps, values."""

from __future__ import annotations

import time
from pathlib import Path

from graphs import Process
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters
from ros_rig import OK, Observer, check_diagnostics
from rosgraph_msgs.msg import Clock


def test_simulated_run(domain: int, tmp_path: Path, observer: Observer) -> None:
    """All nodes are OK while it runs, and report the numbers that a watcher needs, in its time.

    The graph is in a namespace; a foreign clock on /clock, a day later, is ignored. Its parameter
    file has ``/**:`` and a whole number, as most files do: the node converts it to a double.
    """
    start, ticks = 1_625_641_200, 720  # 2021-07-07T02:00-05:00 in seconds since 1970
    names = [f"/site1/{name}" for name in ("plant", "weather", "mpc", "recorder")]
    (tmp_path / "mine.yaml").write_text("/**:\n  ros__parameters:\n    weight: 5\n")
    began = time.time()
    arrays = observer.collect("/diagnostics", lambda message: message)
    intruder = observer.node.create_publisher(Clock, "/clock", 10)
    message = Clock()
    message.clock.sec = start + 86_400
    process = Process(
        domain, "bringup", "--controller", "mpc",
        "--output", "run", "--namespace", "site1", "--hours", "0.2",
        "--speed", "120", "--parameters", "mine.yaml", cwd=tmp_path,
    )
    (weight,) = observer.call(
        GetParameters, "/site1/mpc/get_parameters", names=["weight"]
    ).values
    assert (weight.type, weight.double_value) == (ParameterType.PARAMETER_DOUBLE, 5.0)

    def ended() -> bool:
        intruder.publish(message)
        return process.process.poll() is not None

    observer.until(ended, 120, "the end of the run")
    assert process.wait(300) == 0, process.stderr()
    check_diagnostics(arrays)
    assert observer.diagnoses.keys() == set(names)
    assert {status.level for array in arrays for status in array.status} == {OK}
    plant = observer.values("/site1/plant")
    assert isinstance(plant["roof_level"], float) and plant["tick"] == ticks
    for name in names[:3]:
        site_file = tmp_path / "run" / "configuration" / "site.yaml"
        assert observer.values(name)["site"] == str(site_file)
    assert observer.values(names[3])["bag"] == str(tmp_path / "run" / "bag")
    for name in names:
        stamps = [
            array.header.stamp.sec for array in arrays
            if name in {status.name for status in array.status}
        ]
        # The system's time until the first tick; then it moves with the run until its end.
        moved = [stamp - start for stamp in stamps if stamp < began - 1]
        assert moved == sorted(moved) and 0 <= moved[0] < moved[-1] <= ticks, name
        assert stamps[:-len(moved)] == [stamp for stamp in stamps if stamp >= began - 1], name
