"""``greenroof status``: what it prints, and its exit code, on real graphs."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from commands import run_command
from graphs import Process, environment, wait_for
from page_inputs import alarm, node, pump_report, store
from paper import PAPER_SITE

from greenroof_ros.commands.status import _judge, _write_lines
from greenroof_ros.watch.document import make_document

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


WITHOUT = """
import sys, runpy
sys.modules[sys.argv.pop(1)] = None
runpy.run_module("greenroof_ros", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (("rclpy", "status"), 3, "): source your ROS 2, or"),
    (("aiohttp", "watch"), 2, "needs aiohttp: install greenroof_ros with its extra [watch]"),
    # For monitoring plug-ins 2 is an alarm.
    (("none", "status", "--namespcae"), 3, "unrecognized arguments: --namespcae; did you mean"),
])
def test_what_is_missing_or_wrong_is_reported(
    arguments: tuple[str, ...], code: int, message: str, unused_domain: int, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT, *arguments], cwd=tmp_path, check=False,
        env=environment(unused_domain), capture_output=True, text=True, timeout=300,
    )
    assert (done.returncode, done.stdout) == (code, "")
    assert message in done.stderr and "Traceback" not in done.stderr


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
    assert re.match(r"All is well\. Roof: [0-9.]+.mm below its target; pump: running", lines[0])
    assert lines[1].startswith("What to do: ")
    assert re.match("Simulated run, [0-9.]+ times real time; /site1; 20", lines[2])
    assert [line[:14].strip() for line in lines[3:]] == TILES
    assert re.match("Pump +running +[0-9.]+ L/min", lines[5])
    run.process.send_signal(signal.SIGINT)
    assert run.wait(300) == 130


def test_it_gives_the_pages_words() -> None:
    """Of each alarm what to do; what does not fit is counted."""
    graph = store(
        "live", PAPER_SITE,
        alarm("/roof_sensor: sensor", "roof_sensor", "sensor_lost", "\x1b[31mno answer"),
        *(alarm(f"/camera{number}", "", "", "no picture") for number in range(30)),
    )
    graph.add_statuses(100.0, node("/pump", "pump", at_rest=True, **pump_report("held: frost")))
    page = make_document(graph, 100.0)
    lines = _write_lines(page, _judge(page))
    assert (_judge(page), len(lines)) == (2, 15) and all(map(str.isprintable, lines))
    assert lines[0] == "1 alarm, 30 warnings. Roof sensor: \\x1b[31mno answer; pump: off."
    assert lines[1] == f"What to do: {page['alarms'][0]['do']}"
    assert lines[5] == f"{'Pump':14} {'off':14} frost"
    first = "Alarm, Roof sensor: \\x1b[31mno answer since 05:00. "
    assert lines[9] == first + page["alarms"][0]["do"]
    assert lines[10].startswith("Warning, Camera0: no picture since ")
    unknown = make_document(store("live", PAPER_SITE), 100.0)
    assert not unknown["alarms"] and _judge(unknown) == 2  # a level is unknown
    assert lines[-1] == "and 26 more lines; see 'greenroof watch'"
