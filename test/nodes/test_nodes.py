"""Single nodes: parameters, two masters, what is refused, and a middleware that locks up."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import Process, environment, summary_of, udp_addresses_of, wait_for
from places import CONFIG
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from ros_rig import Observer

START = 1_625_641_200  # 2021-07-07T02:00-05:00 in seconds since 1970


def weights(*values: float) -> list[Any]:
    """Return values of mpc's weight, as messages."""
    return [Parameter("weight", value=value).to_parameter_msg() for value in values]


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


def test_who_sets_and_commands(domain: int, tmp_path: Path, observer: Observer) -> None:
    """The weight can be set during the run, wrong values are refused; a second master ends it."""
    clock = observer.collect("/clock", lambda message: message.clock.sec)
    process = Process(
        domain, "bringup", "--controller", "mpc", "--speed", "10", "--output", "run", cwd=tmp_path
    )
    observer.until(lambda: clock and clock[-1] >= START + 20, 60, "20 ticks")
    refused = observer.call(
        SetParameters, "/mpc/set_parameters", parameters=weights(-1.0, math.nan)
    )
    assert not any(result.successful or "weight" not in result.reason for result in refused.results)
    # A type that no parameter can have is answered, and ends no node.
    alien = ParameterMessage(name="weight", value=ParameterValue(type=42))
    assert not observer.call(SetParameters, "/mpc/set_parameters", parameters=[alien]).results
    site_file = Parameter("site_file", value="x.yaml").to_parameter_msg()
    both = observer.call(  # refused as a whole
        SetParametersAtomically, "/mpc/set_parameters_atomically",
        parameters=[*weights(7.0), site_file],
    )
    assert not both.result.successful and "site_file" in both.result.reason
    accepted = observer.call(
        SetParameters, "/mpc/set_parameters", parameters=weights(*map(float, range(1, 53)))
    )
    assert all(result.successful for result in accepted.results)
    observer.publisher("/pump/command")
    observer.until(lambda: process.process.poll() is not None, 60, "the end of the run")
    assert process.wait(300) == 1 and "Traceback" not in process.stderr()
    # A failed run's summary has all that is known, with the node's message.
    summary = summary_of(tmp_path / "run")
    for text in (process.stderr(), summary["reason"]):
        assert "/pump/command has 2 publishers (mpc, observer)" in text
    assert summary["parameter_change_count"] == 52  # the newest fifty are listed
    assert len(summary["parameter_changes"]) == 50
    last = summary["parameter_changes"][-1]
    assert (last["parameter"], last["before"], repr(last["value"])) == ("weight", 51.0, "52.0")
    assert 20 <= last["tick"] <= summary["last_tick"]


DRIVE = "--ros-args -p drive:=abb_acs880 -p address:=tcp://127.0.0.1:1"
# What the last line has, by command; the sites and sensors are made below.
REFUSED = {
    "nodes.plant --nonsense": ": unrecognized arguments: --nonsense",
    "nodes.controller --controller pid": "package.module:Class",
    "nodes.controller --controller mpc --ros-args -p weight:=-1.0":
        "weight of mpc = -1.0: must be a number greater than 0",
    "nodes.plant --ros-args -p initial_roof_volume:=250.0": "at most 34.4 m3",
    "nodes.plant --ros-args --params-file wrong.yaml":
        "wrong.yaml, line 2: parameter run_lenght of plant = 4: there is no such parameter; did",
    "nodes.weather --ros-args -p run_length:=10000000": "toronto_2021-07.csv",
    "nodes.recorder --ros-args -p directory:=.": ": exists, but the recorder never overwrites",
    # A level counts for 5 s (level_limit), which must cover two readings.
    "live.station --sensors sensors.yaml": "line 22: cistern.period = 2.6: must be at most 2.5 s",
    "live.station --sensors sensors_mqtt.yaml --ros-args -p level_limit:=4.0":
        "line 16: cistern.max_age = 5.0: must be at most 4 s, since older values than",
    "live.station --sensors login.yaml": "/no/greenroof/broker.yaml: ",
    f"live.pump {DRIVE} -p site_file:=slow.yaml -p command_limit:=3.0":
        "command_limit of pump = 3.0: must exceed tau of the",
    f"live.pump {DRIVE} -p folow_time:=9.0":
        "folow_time of pump = '9.0': there is no such parameter; did you mean follow_time?",
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_is_refused(domain: int, tmp_path: Path, command: str) -> None:
    """Exit code 2 and one clear line: a supervisor need not restart it."""
    for file, name, old, new in (
        ("site.yaml", "slow.yaml", "tau: 1.0 ", "tau: 3.0 "),
        ("sensors.yaml", "sensors.yaml", "period: 1.0", "period: 2.6"),
        ("sensors_mqtt.yaml", "sensors_mqtt.yaml", "", ""),
        ("sensors_mqtt.yaml", "login.yaml", "# login: /etc/", "login: /no/"),
    ):
        (tmp_path / name).write_text((CONFIG / file).read_text().replace(old, new))
    (tmp_path / "wrong.yaml").write_text("/**/plant:\n  ros__parameters: {run_lenght: 4}\n")
    done = run_command(*command.split(), cwd=tmp_path, env=environment(domain))
    assert done.returncode == 2 and "Traceback" not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert "error: " in line and REFUSED[command] in line
