"""``greenroof status``: what it prints, and its exit code, on real graphs."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from commands import run_command
from graphs import Process, environment, wait_for
from page_inputs import START, alarm, node, pump_report, store
from peers import Peer, in_domain, repeating
from places import CONFIG
from test_watch_command import WITHOUT

from greenroof_ros.ros.reports import Status
from greenroof_ros.site.file import read_site
from greenroof_ros.watch.document import join_summary, make_document

TILES = ["Roof level", "Cistern level", "Pump", "Watering", "Rain", "Temperature"]


def status(domain: int, cwd: Path, *arguments: str) -> tuple[int, list[str]]:
    """Return its exit code and lines; nothing goes to standard error, and no control characters."""
    done = run_command("status", *arguments, cwd=cwd, env=environment(domain))
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert all(line.isprintable() and "\N{NO-BREAK SPACE}" not in line for line in lines)
    return done.returncode, lines


def test_nothing_runs(domain: int, tmp_path: Path) -> None:
    """One line, and 3, for cron without a terminal or standard input; it leaves nothing."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    done = subprocess.run(
        [sys.executable, "-m", "greenroof_ros", "status"], cwd=tmp_path, check=False,
        env={**environment(domain), "TERM": "xterm-256color", "FORCE_COLOR": "1", "LC_ALL": "C"},
        stdin=subprocess.DEVNULL, capture_output=True, timeout=300,
    )
    assert (done.returncode, done.stderr) == (3, b"")
    assert b"No run or site has been found" in done.stdout and b"\x1b" not in done.stdout
    assert not list(tmp_path.iterdir())
    assert status(domain, tmp_path, "--namespace", "site1")[0] == 3


def test_without_ros_an_output_or_a_known_option_it_is_unknown(
    unused_domain: int, tmp_path: Path
) -> None:
    environ = environment(unused_domain)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT.replace("watch", "status"), "rclpy"],
        cwd=tmp_path, env=environ, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 3
    assert "ROS 2 is not available: source your ROS 2, or" in done.stderr
    assert "Traceback" not in done.stderr
    done = run_command("status", "--namespcae", cwd=tmp_path, env=environ)
    assert (done.returncode, done.stdout) == (3, "")  # for monitoring plug-ins 2 is an alarm
    assert "unrecognized arguments: --namespcae; did you mean --namespace?" in done.stderr
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "greenroof_ros", "status", "--help"], cwd=tmp_path, env=environ,
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )
    assert (done.returncode, done.stderr) == (3, "error: No space left on device\n")


def test_a_run_that_is_well_and_then_has_warnings(domain: int, tmp_path: Path) -> None:
    """In a namespace. A roof that is too dry while it is watered is no warning.

    Another device is a warning at most; what does not fit is counted.
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
    assert re.match(r"All is well\. The roof is [0-9.]+.mm below its target; the pump", lines[0])
    assert lines[1].startswith("What to do: ")
    assert re.match("Simulated run, [0-9.]+ times real time; /site1; 20", lines[2])
    assert [line[:14].strip() for line in lines[3:]] == TILES
    assert re.match("Pump +running +[0-9.]+ L/min", lines[5])
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == 130


def test_it_gives_the_pages_words(domain: int, tmp_path: Path) -> None:
    """Why the pump is off, and of each alarm what to do; what does not fit is counted."""
    pytest.importorskip("rclpy", reason="nodes need ROS 2")
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    why = "the level of the roof is unknown"
    reports = node("/pump", "pump", at_rest=True, **pump_report(f"held: {why}"))
    alarms = [
        alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", "\x1b[31mno answer"),
        *(alarm(f"/camera{number}", "", "", "no picture") for number in range(30)),
    ]
    graph = store("live", read_site(CONFIG / "site.yaml"), *alarms)
    graph.add_statuses(100.0, reports)
    page = make_document(graph, 100.0)
    with in_domain(domain), closing(Peer(domain, "nodes")) as peer:

        def message(statuses: list[Status]) -> DiagnosticArray:
            said = DiagnosticArray(status=[
                DiagnosticStatus(
                    name=each.name, level=bytes([each.level]), message=each.message,
                    values=[KeyValue(key=key, value=text) for key, text in each.values.items()],
                ) for each in statuses
            ])
            said.header.stamp.sec = START // 10**9
            return said

        topics = [
            (peer.node.create_publisher(DiagnosticArray, topic, 8), message(statuses))
            for topic, statuses in (("/diagnostics", reports), ("/alarms", alarms))
        ]

        def say() -> None:
            for publisher, said in topics:
                publisher.publish(said)

        with repeating(say, 0.5):
            code, lines = wait_for(
                lambda: (seen := status(domain, tmp_path))[1][0] == join_summary(page) and seen,
                60, "the page's summary",
            )
    assert (code, len(lines)) == (2, 15)
    assert lines[0] == (
        "1 alarm, 30 warnings. Roof sensor: \\x1b[31mno answer; the pump is off."
    )
    assert lines[1].startswith("What to do: ") and page["alarms"][0]["do"] in lines[1]
    for line, name in ((lines[3], "roof"), (lines[5], "pump")):
        tile = page["tiles"][name]
        assert line.startswith(f"{tile['label']:14} {tile['value']:14} {tile['sentence']}")
    first = "Alarm, Roof sensor: \\x1b[31mno answer since 20 Jul 00:00:30. "
    assert lines[9] == first + page["alarms"][0]["do"]
    assert lines[10].startswith("Warning, Camera0: no picture since ")
    assert lines[-1] == "and 27 more lines; see 'greenroof watch'"
