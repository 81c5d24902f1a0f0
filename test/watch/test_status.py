"""``greenroof status``: what it prints, and its exit code, on real graphs."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from commands import run_command
from graphs import Process, environment, wait_for
from paper import PAPER_SITE
from peers import Peer, in_domain, repeating
from test_watch_command import WITHOUT

TILES = ["Roof level", "Cistern level", "Pump", "Rain", "Controller"]
KEYS = {
    "status", "exit_code", "summary", "advice", "mode", "namespace", "time", "times_real_time",
    "cistern_level_m", "roof_level_m", "pump", "pump_why", "pump_stands",
    "pump_flow_m3_s", "command", "controller", "rain_m_s", "forecast_rain_m", "forecast_reach_s",
    "alarms", "notes",
}


def status(domain: int, cwd: Path, *arguments: str) -> tuple[int, list[str]]:
    """Return its exit code and lines; nothing goes to standard error, and no control characters."""
    done = run_command("status", *arguments, cwd=cwd, env=environment(domain))
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert all(line.isprintable() and "\N{NO-BREAK SPACE}" not in line for line in lines)
    return done.returncode, lines


def data(domain: int, cwd: Path, *arguments: str) -> dict[str, Any]:
    """Return what it prints as JSON."""
    code, lines = status(domain, cwd, "--json", *arguments)
    values: dict[str, Any] = json.loads("\n".join(lines))
    assert (values.keys(), values["exit_code"]) == (KEYS, code)
    return values


def test_nothing_runs(domain: int, tmp_path: Path) -> None:
    """One line, and 3, for cron without a terminal or standard input; it leaves nothing."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "status"], cwd=tmp_path, check=False,
        env={**environment(domain), "TERM": "xterm-256color", "FORCE_COLOR": "1", "LC_ALL": "C"},
        stdin=subprocess.DEVNULL, capture_output=True, timeout=300,
    )
    assert (done.returncode, done.stderr) == (3, b"")
    assert b"no run or site is found" in done.stdout and b"\x1b" not in done.stdout
    assert not list(tmp_path.iterdir())
    values = data(domain, tmp_path, "--namespace", "site1")
    assert (values["status"], values["mode"]) == ("nothing running", "none")
    assert values["roof_level_m"] is None and values["alarms"] == []


def test_without_ros_an_output_or_a_known_option_it_is_unknown(
    unused_domain: int, tmp_path: Path
) -> None:
    environ = environment(unused_domain)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.replace("watch", "status"), "rclpy"],
        cwd=tmp_path, env=environ, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 3
    assert "no ROS 2 here: source yours" in done.stderr and "Traceback" not in done.stderr
    done = run_command("status", "--jsno", cwd=tmp_path, env=environ)
    assert (done.returncode, done.stdout) == (3, "")  # for monitoring plug-ins 2 is an alarm
    assert "unrecognized arguments: --jsno; did you mean --json?" in done.stderr
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status", "--help"], cwd=tmp_path, env=environ,
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )
    assert (done.returncode, done.stderr) == (3, "error: No space left on device\n")


def test_a_run_that_is_well_and_then_has_warnings(domain: int, tmp_path: Path) -> None:
    """In a namespace. A roof that is too dry while it is watered is no warning.

    What the roof has came from the cistern: at the start there were 57 m3, all of them there.
    Another device is a warning at most; what does not fit is counted, and in the JSON.
    """
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    run = Process(
        domain, "bringup", "--controller", "onoff", "--hours", "2", "--speed", "2", "--cistern",
        "57", "--roof", "0", "--namespace", "site1", "--output", "run", cwd=tmp_path,
    )
    run.wait_for_ticks(1000)
    wait_for(lambda: status(domain, tmp_path, "--namespace", "site1")[0] == 0, 60, "a run")
    code, lines = status(domain, tmp_path, "--namespace", "site1")
    assert (code, len(lines)) == (0, 3 + len(TILES))
    assert lines[0].startswith("No alarms. The roof is ")
    assert lines[1].startswith("What to do: ")
    assert re.match("Simulated run, [0-9.]+ times real time; /site1; 20", lines[2])
    assert [line[:14].strip() for line in lines[3:]] == TILES
    # On a busy machine forecast and flow can come after the first two seconds.
    values = wait_for(
        lambda: None not in (
            (seen := data(domain, tmp_path, "--namespace", "/site1"))["forecast_rain_m"],
            seen["pump_flow_m3_s"],
        ) and seen, 240, "forecast and flow",
    )
    assert (values["status"], values["mode"], values["namespace"]) == (
        "well", "simulated", "/site1"
    )
    on_roof = values["roof_level_m"] * PAPER_SITE.a2
    assert 0 < on_roof < PAPER_SITE.z_veg * PAPER_SITE.a2
    assert values["cistern_level_m"] * PAPER_SITE.a1 + on_roof == pytest.approx(57, rel=0.01)
    assert values["times_real_time"] == pytest.approx(2, rel=0.3)
    assert (values["controller"], values["pump"]) == ("onoff", "running")
    assert values["command"] == 1.0 and values["pump_flow_m3_s"] > 0
    assert values["forecast_rain_m"] >= 0 and 0 < values["forecast_reach_s"] <= 43_200
    assert values["alarms"] == []
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    with in_domain(domain), closing(Peer(domain, "camera")) as peer:
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 8)
        message = DiagnosticArray(status=[
            DiagnosticStatus(name=f"/camera{number}", level=b"\x02", message="\x1b[31mno picture")
            for number in range(30)
        ])
        with repeating(lambda: publisher.publish(message), 0.5):
            code, lines = wait_for(
                lambda: (seen := status(domain, tmp_path, "--namespace", "site1"))[0] == 1
                and seen, 60, "a warning",
            )
            values = data(domain, tmp_path, "--namespace", "site1")
    assert (code, len(lines)) == (1, 15)
    assert lines[0].startswith("30 warnings. The roof is ")
    assert lines[8] == "Alarm: /camera0: \N{REPLACEMENT CHARACTER}[31mno picture"
    assert lines[-1] == "and 24 more: see 'greenroof watch', or --json"
    assert (values["status"], len(values["alarms"])) == ("warning", 30)
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == 130


