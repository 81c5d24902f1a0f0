"""Single nodes: what is refused, and a middleware that locks up."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import environment, udp_addresses_of, wait_for
from places import CONFIG


def test_middleware_that_locks_up_at_the_end(domain: int, tmp_path: Path) -> None:
    """Even if the teardown hangs and no Python can run, the node ends."""
    hangs = (
        "import ctypes; from rclpy.node import Node; from greenroof_ros.nodes.weather import main; "
        "Node.destroy_node = lambda node: ctypes.PyDLL(None).sleep(60); main()"
    )
    process = subprocess.Popen([sys.executable, "-c", hangs], cwd=tmp_path, env=environment(domain))
    wait_for(lambda: udp_addresses_of(process.pid), 60, "the start of the node")
    process.send_signal(signal.SIGINT)
    assert process.wait(300) == -signal.SIGALRM


DRIVE = "--ros-args -p drive:=abb_acs880 -p address:=tcp://127.0.0.1:1"
# What the last line names, by command; the sites and sensors are made below.
REFUSED = {
    "nodes.controller --controller mpc --ros-args -p weight:=-1.0": "weight of mpc = -1.0: ",
    "nodes.plant --ros-args --params-file wrong.yaml":
        "wrong.yaml, line 2: parameter run_lenght of plant = 4: ",
    "nodes.recorder --ros-args -p directory:=.": ": exists, but ",
    # A level counts for 5 s (level_limit), which must cover two readings.
    "live.station --sensors sensors.yaml": "line 22: cistern.period = 2.6: ",
    "live.station --sensors sensors_mqtt.yaml --ros-args -p level_limit:=4.0":
        "line 16: cistern.max_age = 5.0: ",
    f"live.pump {DRIVE} -p folow_time:=9.0": "folow_time of pump = '9.0': ",
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_is_refused(domain: int, tmp_path: Path, command: str) -> None:
    """Exit code 2 and one clear line: a supervisor need not restart it."""
    for file in ("sensors.yaml", "sensors_mqtt.yaml"):
        text = (CONFIG / file).read_text().replace("period: 1.0", "period: 2.6")
        (tmp_path / file).write_text(text)
    (tmp_path / "wrong.yaml").write_text("/**/plant:\n  ros__parameters: {run_lenght: 4}\n")
    done = run_command(*command.split(), cwd=tmp_path, env=environment(domain))
    assert done.returncode == 2 and "Traceback" not in done.stderr
    line = done.stderr.splitlines()[-1]
    assert "error: " in line and REFUSED[command] in line
