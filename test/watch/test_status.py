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
from peers import Peer, in_domain
from test_watch_command import WITHOUT, running_pump

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
    """One line, and 3; a graph in another namespace is another graph."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    code, (line,) = status(domain, tmp_path)
    assert code == 3
    assert "no run or site is found" in line
    values = data(domain, tmp_path, "--namespace", "site1")
    assert (values["status"], values["mode"]) == ("nothing running", "none")
    assert values["roof_level_m"] is None and values["alarms"] == []


@pytest.mark.parametrize(("arguments", "message"), [
    (("--jsno",), "unrecognized arguments: --jsno; did you mean --json?"),
    (("--namespace", "1"), "argument --namespace: invalid namespace"),
])
def test_wrong_usage_is_unknown_not_an_alarm(
    arguments: tuple[str, ...], message: str, unused_domain: int, tmp_path: Path
) -> None:
    """As for monitoring plug-ins: 2 would be an alarm."""
    done = run_command("status", *arguments, cwd=tmp_path, env=environment(unused_domain))
    assert (done.returncode, done.stdout) == (3, "")
    assert message in done.stderr


def test_without_ros_or_an_output_it_is_unknown(unused_domain: int, tmp_path: Path) -> None:
    environ = environment(unused_domain)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.replace("watch", "status"), "rclpy"],
        cwd=tmp_path, env=environ, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 3
    assert "no ROS 2 here: source yours" in done.stderr and "Traceback" not in done.stderr
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status", "--help"], cwd=tmp_path, env=environ,
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )
    assert done.returncode == 3
    assert done.stderr == "error: standard output cannot be written: No space left on device\n"


def test_a_run_that_is_well(domain: int, tmp_path: Path) -> None:
    """In a namespace. A roof that is too dry while it is watered is no warning.

    What the roof has came from the cistern: at the start there were 57 m3, all of them there.
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
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == 130


def test_a_warning_and_more_alarms_than_lines(domain: int, tmp_path: Path) -> None:
    """Another device is a warning at most; what does not fit is counted, and in the JSON."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    run = Process(
        domain, "bringup", "--controller", "onoff", "--hours", "2", "--speed", "5",
        "--output", "run", cwd=tmp_path,
    )
    run.wait_for_ticks(1000)
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    with in_domain(domain), closing(Peer(domain, "camera")) as peer:
        publisher = peer.node.create_publisher(DiagnosticArray, "/diagnostics", 8)
        message = DiagnosticArray(status=[
            DiagnosticStatus(name=f"/camera{number}", level=b"\x02", message="\x1b[31mno picture")
            for number in range(30)
        ])
        timer = Repeater(lambda: publisher.publish(message))
        try:
            code, lines = wait_for(
                lambda: (seen := status(domain, tmp_path))[0] == 1 and seen, 60, "a warning"
            )
            values = data(domain, tmp_path)
        finally:
            timer.stop()
    assert (code, len(lines)) == (1, 15)
    assert lines[0].startswith("30 warnings. The roof is ")
    assert lines[8] == "Alarm: /camera0: \N{REPLACEMENT CHARACTER}[31mno picture"
    assert lines[-1] == "and 24 more: see 'greenroof watch', or --json"
    assert (values["status"], len(values["alarms"])) == ("warning", 30)
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == 130


class Repeater:
    """Calls a function twice a second."""

    def __init__(self, act: Any) -> None:
        from threading import Event, Thread

        self._over = Event()

        def repeat() -> None:
            while not self._over.wait(0.5):
                act()

        self._thread = Thread(target=repeat)
        self._thread.start()

    def stop(self) -> None:
        self._over.set()
        self._thread.join()


def test_a_drive_that_has_a_fault_is_an_alarm(domain: int, tmp_path: Path) -> None:
    """With its code. A hold is a warning; so is a drive file no one has verified."""
    namespace = "--namespace", "site1"
    with running_pump(domain, tmp_path) as (_, drive):
        def until(code: int, pump: str) -> dict[str, Any]:
            return wait_for(
                lambda: (seen := data(domain, tmp_path, *namespace))["exit_code"] == code
                and seen["pump"] == pump and seen, 90, f"{code}, {pump}",
            )

        running = until(1, "running")
        assert (running["mode"], running["pump_stands"]) == ("live", False)
        stop(domain, tmp_path)
        held = until(1, "held")
        wait_for(
            lambda: data(domain, tmp_path, *namespace)["pump_stands"], 90, "a reported standstill"
        )
        assert held["alarms"][0]["code"] == "hold"
        assert {alarm["level"] for alarm in held["alarms"]} == {"warn"}
        drive.inject("drive_fault")
        fault = until(2, "fault")
        assert fault["alarms"][0]["code"] == "drive_fault"
        code, lines = status(domain, tmp_path, *namespace)
        assert code == 2 and len(lines) <= 15
        assert any(line.startswith("Alarm: /site1/pump: pump: ") for line in lines)
        (pump,) = (line for line in lines if line.startswith("Pump "))
        assert pump.endswith("; stopped, according to the drive")


def stop(domain: int, cwd: Path) -> None:
    """Stop the pump as an operator does."""
    from ros_rig import Observer
    from std_srvs.srv import SetBool

    with in_domain(domain), closing(Observer(domain, cwd)) as operator:
        assert operator.call(SetBool, "/site1/pump/stop", data=True).success


def test_it_needs_no_terminal_and_leaves_nothing(domain: int, tmp_path: Path) -> None:
    """Over ssh and by cron: no standard input, and the same bytes for any TERM."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    outputs = set()
    for term in ("xterm-256color", ""):
        done = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status"], cwd=tmp_path, check=False,
            env={**environment(domain), "TERM": term, "FORCE_COLOR": "1", "LC_ALL": "C"},
            stdin=subprocess.DEVNULL, capture_output=True, timeout=300,
        )
        assert done.returncode == 3 and done.stderr == b""
        outputs.add(done.stdout)
    assert len(outputs) == 1 and b"\x1b" not in outputs.pop()
    assert not list(tmp_path.iterdir())
