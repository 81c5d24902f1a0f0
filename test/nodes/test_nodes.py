"""Single nodes in a simulated graph: parameters, refused values, two masters, time."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from commands import run_command
from graphs import Process, environment, summary_of, udp_addresses_of, wait_for
from places import CONFIG
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import (
    GetParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from ros_rig import Observer
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64, Float64MultiArray

START = 1_625_641_200  # 2021-07-07T02:00-05:00 in seconds since 1970


def parameter(observer: Observer, node: str, name: str) -> ParameterValue:
    """Return a parameter of a node."""
    return observer.call(GetParameters, f"{node}/get_parameters", names=[name]).values[0]


def set_weight(observer: Observer, value: float) -> Any:
    """Set mpc's weight, and return the answer; integers stay integers, as with ros2 param."""
    weight = Parameter("weight", value=value).to_parameter_msg()
    return observer.call(SetParameters, "/mpc/set_parameters", parameters=[weight]).results[0]


def test_bad_command_acts_as_zero_and_is_counted(observer: Observer) -> None:
    """A command that is not finite or negative never becomes a flow."""
    bad = cycle([math.nan, math.inf, -0.5, -math.inf])
    publisher = observer.publisher("/pump/command")
    observer.collect("/roof/level", lambda _: publisher.publish(Float64(data=next(bad))))
    flows = observer.collect("/pump/flow")
    plant = observer.start("nodes.plant", run_length=20)
    observer.start("nodes.weather")
    observer.until(lambda: "metrics" in observer.values("/plant"), 60, "the end of the run")
    # The report can come before the last flow, which is another topic.
    observer.until(lambda: len(flows) >= 21, 60, "the last flow")
    report = observer.values("/plant")
    assert report["refused"] == {"/pump/command": 21}
    assert report["metrics"]["pumped_m3"] == 0.0
    assert flows == [0.0] * 21
    plant.terminate()
    assert plant.wait(300) in (0, -signal.SIGALRM)


@pytest.mark.parametrize(
    "when", ["Node.destroy_node = lambda node: hang()", "import atexit; atexit.register(hang)"],
    ids=["destroy_node", "end of the process"],
)
def test_middleware_that_locks_up_at_the_end(domain: int, tmp_path: Path, when: str) -> None:
    """Even if the teardown hangs and no Python can run, the node ends."""
    hangs = (
        "import ctypes; from rclpy.node import Node; from greenroof_ros.nodes.weather import main; "
        f"hang = lambda: ctypes.PyDLL(None).sleep(60); {when}; main()"
    )
    process = subprocess.Popen([sys.executable, "-c", hangs], cwd=tmp_path, env=environment(domain))
    wait_for(lambda: udp_addresses_of(process.pid), 60, "the start of the node")
    process.send_signal(signal.SIGINT)
    assert process.wait(300) == -signal.SIGALRM


def test_a_start_without_an_offset_is_of_the_sites_clock(
    tmp_path: Path, observer: Observer
) -> None:
    """02:00 in Toronto in July, with daylight saving time, is an hour before 02:00-05:00."""
    site = tmp_path / "site.yaml"
    site.write_text(f"extends: {CONFIG / 'site.yaml'}\ntime_zone: America/Toronto\n")
    rain = observer.collect("/weather/precipitation")
    clock, run = observer.publisher("/clock"), observer.publisher("/run")
    observer.start("nodes.weather", site_file=site, start="2021-07-07T02:00")
    run.publish(Float64MultiArray(data=[7.0, 9.0, 0.0]))
    clock.publish(Clock(clock=Time(sec=START - 3600)))
    observer.until(lambda: rain, 60, "the weather of tick 0")


def test_who_sets_and_commands(domain: int, tmp_path: Path, observer: Observer) -> None:
    """The weight can be set during the run, wrong values are refused; a second master ends it."""
    clock = observer.collect("/clock", lambda message: message.clock.sec)
    process = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "10", "--output", "run", cwd=tmp_path
    )
    observer.until(lambda: clock and clock[-1] >= START + 20, 60, "20 ticks")
    for bad in (-1.0, math.nan):
        refused = set_weight(observer, bad)
        assert not refused.successful and "weight" in refused.reason
    site_file = Parameter("site_file", value="x.yaml").to_parameter_msg()
    both = [Parameter("weight", value=7.0).to_parameter_msg(), site_file]  # refused as a whole
    answer = observer.call(
        SetParametersAtomically, "/mpc/set_parameters_atomically", parameters=both
    )
    assert not answer.result.successful and "site_file" in answer.result.reason
    for value in map(float, range(1, 53)):
        assert set_weight(observer, value).successful
    observer.publisher("/pump/command")
    observer.until(lambda: process.process.poll() is not None, 60, "the end of the run")
    assert process.wait(300) == 1
    assert "/pump/command has 2 publishers (mpc, observer)" in process.stderr()
    assert "Traceback" not in process.stderr()
    # A failed run's summary has all that is known, with the node's message.
    summary = summary_of(tmp_path / "run")
    assert "/pump/command has 2 publishers (mpc, observer)" in summary["reason"]
    assert summary["parameter_change_count"] == 52  # the newest fifty are listed
    assert len(summary["parameter_changes"]) == 50
    last = summary["parameter_changes"][-1]
    assert (last["parameter"], last["before"], repr(last["value"])) == ("weight", 51.0, "52.0")
    assert 20 <= last["tick"] <= summary["last_tick"]


DRIVE = "--ros-args -p drive:=abb_acs880 -p address:=tcp://127.0.0.1:1"
# The message by command; the sites and sensors are made below.
REFUSED = {
    "nodes.plant --nonsense": ("--nonsense",),
    "nodes.controller --controller pid": ("pid", "mpc", "package.module:Class"),
    "nodes.controller --controller mpc --ros-args -p weight:=-1.0":
        ("weight", "-1.0", "greater than 0"),
    "nodes.plant --ros-args -p initial_roof_volume:=250.0":
        ("at most 34.4 m3", "is the unit wrong?"),
    "nodes.plant --ros-args --params-file wrong.yaml":
        ("wrong.yaml, line 2: parameter run_lenght of plant = 4: ", "did you mean run_length?"),
    "nodes.weather --ros-args -p run_length:=10000000": ("toronto_2021-07.csv",),
    "nodes.recorder --ros-args -p directory:=.": ("directory", "exists"),
    # A level counts for 5 s (level_limit), which must cover two readings.
    "live.station --sensors sensors.yaml":
        ("line 22: cistern.period = 2.6: must be at most 2.5 s",),
    "live.station --sensors sensors_mqtt.yaml --ros-args -p level_limit:=4.0":
        ("line 16: cistern.max_age = 5.0: must be at most 4 s, since older values than",),
    "live.station --sensors login.yaml":
        ("/no/greenroof/broker.yaml: ",),
    f"live.pump {DRIVE} -p folow_time:=9.0":
        ("folow_time of pump = '9.0': there is no such parameter; did you mean follow_time?",),
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_is_refused(domain: int, tmp_path: Path, command: str) -> None:
    """Exit code 2 and one clear line: a supervisor need not restart it."""
    for file, name, old, new in (
        ("sensors.yaml", "sensors.yaml", "period: 1.0", "period: 2.6"),
        ("sensors_mqtt.yaml", "sensors_mqtt.yaml", "", ""),
        ("sensors_mqtt.yaml", "login.yaml", "# login: /etc/", "login: /no/"),
    ):
        (tmp_path / name).write_text((CONFIG / file).read_text().replace(old, new))
    (tmp_path / "wrong.yaml").write_text("/**/plant:\n  ros__parameters: {run_lenght: 4}\n")
    done = run_command(*command.split(), cwd=tmp_path, env=environment(domain))
    assert done.returncode == 2, done.stderr
    # The parameters are known only after the node exists, which may have logged something.
    (line,) = [line for line in done.stderr.splitlines() if not line.startswith("[INFO]")]
    assert line.startswith("error: ")
    assert all(word in line for word in REFUSED[command]), line
