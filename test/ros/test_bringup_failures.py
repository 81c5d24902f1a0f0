"""What a run does when a person stops it, when it is killed, and when a controller fails."""

from __future__ import annotations

import re
import signal
import time
from contextlib import closing
from pathlib import Path

import pytest
from commands import run_command
from graphs import (
    Process,
    assert_on_loopback_alone,
    environment,
    messages_of,
    summary_of,
)
from peers import in_domain
from rosbags.highlevel import AnyReader

from greenroof_ros.results.metrics import METRICS

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from ros_rig import Observer


def test_what_ends_a_run(domain: int, tmp_path: Path) -> None:
    """A signal: at once, with exit code 130, no traceback, and the bag closed.

    Ignored signals, as under nohup and in a shell's background, end nothing. The run reports how
    and where it ended.
    """
    ignored, run = (signal.SIGHUP, signal.SIGINT), tmp_path / "run"
    process = Process(
        domain, "bringup", "--controller", "mpc", "--output", "run", cwd=tmp_path, ignored=ignored
    )
    process.wait_for_ticks(size=10_000)
    assert summary_of(run)["status"] == "running"
    for signal_number in ignored:
        process.process.send_signal(signal_number)
    process.wait_for_ticks(size=30_000)
    for _ in range(3):  # a second and a third do not disturb the end
        process.process.send_signal(signal.SIGTERM)
        time.sleep(0.05)
    assert process.wait(300) == 130
    printed, summary, ticks = process.stderr(), summary_of(run), len(messages_of(run)["/clock"])
    assert "Traceback" not in printed
    assert summary["status"] == "interrupted"
    assert summary["reason"] == "interrupted by SIGTERM" and summary["reason"] in printed
    assert (summary["controller"], summary["steps"]) == ("mpc", 43200)
    assert not [metric.name for metric in METRICS if metric.name in summary]
    # The last tick was begun. On a busy machine the recorder can lag by as many messages as the
    # plant keeps for it.
    assert ticks - 1 <= summary["last_tick"] <= ticks + 64
    assert f"the unfinished run is in {run}\n" in printed


def test_kill_leaves_all_but_a_chunk(domain: int, tmp_path: Path) -> None:
    """The bag of a run that was killed is recovered up to the ticks not yet flushed, at most 32."""
    with in_domain(domain), closing(Observer(domain, tmp_path)) as observer:
        process = Process(
            domain, "bringup", "--controller", "mpc",
            "--output", "run", "--speed", "20", cwd=tmp_path
        )
        levels = observer.collect("/roof/level")
        observer.until(lambda: len(levels) > 100, 60, "100 ticks")
        process.process.kill()
        process.process.wait(300)
        for _ in range(64):  # what is on the way to a slow observer
            observer.executor.spin_once(timeout_sec=0.02)
    assert summary_of(tmp_path / "run")["status"] == "running"
    done = run_command("recover", "run", cwd=tmp_path, env=environment(domain))
    assert done.returncode == 0, done.stderr
    with AnyReader([tmp_path / "run" / "bag-recovered"]) as reader:
        (ticks,) = {connection.msgcount for connection in reader.connections}
    assert 60 < len(levels) - 40 <= ticks <= len(levels) + 40


def test_a_graph_of_its_own(domain: int, tmp_path: Path) -> None:
    """A second bringup in the namespace exits with code 3 and advice, and the first continues.

    It listens only on 127.0.0.1, and uses no shared memory that others could lock. It also ignores
    a port there left by a process that was killed while making it (full size, but still empty). The
    ports of the domain's first participants are at
    7411 + 250 domain + 2 number (RTPS 2.5, 9.6.2.4).
    """
    ports = [
        Path(f"/dev/shm/fastrtps_port{7411 + 250 * domain + 2 * number}") for number in range(8)
    ]
    for port in ports:
        port.write_bytes(bytes(52400))
    try:
        process = Process(domain, "bringup", "--controller", "mpc",
                          "--speed", "20", "--output", "run", "--namespace",
                          "/site1", cwd=tmp_path)
        process.wait_for_ticks(size=0)
        second = Process(domain, "bringup", "--controller", "mpc",
                         "--output", "second", "--namespace", "site1",
                         cwd=tmp_path)
        assert second.wait(300) == 3
        assert all(words in second.stderr() for words in ("namespace /site1", "--namespace"))
        assert not (tmp_path / "second").exists()
        assert_on_loopback_alone(process.process.pid)
        process.process.send_signal(signal.SIGINT)
        assert process.wait(300) == 130
    finally:
        for port in ports:
            port.unlink(missing_ok=True)


# --- what a user's controller does wrong ----------------------------------------------------------

MINE = """
import time

class Mine:
    parameters = ()

    def __init__(self, site):
        self.tick = 0

    def command(self, *inputs):
        self.tick += 1
        if self.tick == 20:
            IN_TICK
        return 1.0

    def skip(self):
        pass

    def statistics(self):
        return AT_END
"""
HANGS = "did not return within 2 s; it was executing .*mine.py, line 13"
# What stands in its code, and the line that the run ends with.
WRONG = {
    "waits for ever": ("IN_TICK", "time.sleep(600)", HANGS),
    "fails": ("IN_TICK", "1 / 0", "mine.py, line 13: Mine.command: raises Zero"),
    "fails at the end": ("AT_END", "1 / 0", "mine.py, line 20: Mine.statistics: raises Zero"),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_controller_that_hangs_or_fails_ends_the_run(
    domain: int, tmp_path: Path, case: str
) -> None:
    """In one line with its place; the bag is closed, and the summary states why."""
    name, code, reason = WRONG[case]
    text = MINE.replace(name, code).replace("IN_TICK", "pass").replace("AT_END", "None")
    (tmp_path / "mine.py").write_text(text)
    process = Process(
        domain, "bringup", "--controller", "mine:Mine", "--hours", "0.02", "--peer-limit", "2",
        "--speed", "60", "--output", "run", cwd=tmp_path,
    )
    # Its code is refused as other wrong input is; what does not answer is a node that failed.
    assert process.wait(300) == (1 if reason is HANGS else 2)
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == "failed"
    assert re.search(reason, summary["reason"]), summary["reason"]
    assert f"error: {summary['reason']}\n" in process.stderr()
    assert "Traceback" not in process.stderr()
    bag = tmp_path / "run" / "bag"
    assert (bag / "metadata.yaml").exists()
