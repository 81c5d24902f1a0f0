"""What a run does when a person stops it, when it is killed, and when a part of it fails."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import yaml
from commands import run_command
from graphs import (
    Process,
    assert_on_loopback_alone,
    bag_file,
    environment,
    messages_of,
    summary_of,
    wait_for,
)
from places import CHECKOUT
from rosbags.highlevel import AnyReader

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from ros_rig import Observer


def bag_topics(*outputs: str) -> set[str]:
    """Return what is recorded of each tick without a valve, and these, by msg_defs/topics.yaml."""
    topics = yaml.safe_load((CHECKOUT / "msg_defs" / "topics.yaml").read_text())["topics"]
    return {
        name for name, entry in topics.items() if entry["per_tick"]
        and (name in outputs or not (entry.get("optional") or entry.get("needs")))
    }


def test_kill_leaves_all_but_a_chunk(domain: int, tmp_path: Path, observer: Observer) -> None:
    """The bag of a run that was killed is recovered up to the ticks not yet flushed, at most 32."""
    levels = observer.collect("/roof/level")
    process = Process(domain, "bringup", "--output", "run", "--speed", "50", cwd=tmp_path)
    observer.until(lambda: len(levels) > 100, 60, "100 ticks")
    process.process.kill()
    process.process.wait(300)
    assert summary_of(tmp_path / "run")["status"] == "running"
    done = run_command("recover", "run", "--output", "bag", cwd=tmp_path, env=environment(0))
    assert done.returncode == 0, done.stderr
    with AnyReader([tmp_path / "bag"]) as reader:  # an independent reader
        (ticks,) = {connection.msgcount for connection in reader.connections}
    assert ticks >= len(levels) - 40 > 60


def test_a_graph_of_its_own(domain: int, tmp_path: Path) -> None:
    """Each in its namespace; a second one in it exits with 3 and advice, the first continues.

    It listens only on 127.0.0.1, and uses no shared memory that others could lock.
    """
    run, sites = ("bringup", "--speed", "20", "--namespace"), {"site1": "mpc", "site2": "onoff"}
    together = {
        site: Process(domain, *run, site, "--controller", name, "--output", site, cwd=tmp_path)
        for site, name in sites.items()
    }
    for site in together:
        wait_for(lambda site=site: bag_file(tmp_path / site).exists(), 60, f"the bag of {site}")
    second = Process(domain, *run, "site1", "--output", "second", cwd=tmp_path)
    assert second.wait(300) == 3 and "namespace /site1" in second.stderr()
    assert not (tmp_path / "second").exists()
    topics = bag_topics("/controller/cost", "/controller/solver_status"), bag_topics()
    for (site, process), outputs in zip(together.items(), topics, strict=True):
        assert_on_loopback_alone(process.process.pid)
        process.process.send_signal(signal.SIGINT)
        assert process.wait(300) == 130
        assert messages_of(tmp_path / site).keys() == {f"/{site}{topic}" for topic in outputs}


MINE = """
import os, signal, time
from greenroof_ros.results.bag_write import BagWriter
from greenroof_ros.ros.alarms import Judge

def full(bag):
    raise OSError(28, "No space left on device")

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
        return None
"""
FULL = "BagWriter.close = full; os.kill(os.getpid(), signal.SIGTERM)"
# What stands in its code; the exit code, the status, and what is named. The code of a user is
# refused as other wrong input is; what does not answer is a node that failed.
WRONG = {
    "waits for ever": ("time.sleep(600)", 1, "failed", "mine.py, line 18"),
    "fails": ("1 / 0", 2, "failed", "mine.py, line 18"),
    "ends, and the disk is full": (FULL, 1, "interrupted", "No space left on device"),
    "no alarms": ("Judge.update = None", 0, "done", "TypeError: "),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_fails_in_a_run(domain: int, tmp_path: Path, case: str) -> None:
    """Its line states the place; the bag is closed if it can be, and the summary states why."""
    text, code, status, named = WRONG[case]
    (tmp_path / "mine.py").write_text(MINE.replace("IN_TICK", text))
    process = Process(
        domain, "bringup", "--controller", "mine:Mine", "--hours", "0.02", "--speed", "60",
        "--peer-limit", "2" if case == "waits for ever" else "60", "--output", "run", cwd=tmp_path,
    )
    assert process.wait(300) == code, process.stderr()
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == status
    assert named in process.stderr() and "Traceback" not in process.stderr()
    assert status != "failed" or f"error: {summary['reason']}\n" in process.stderr()
    assert (tmp_path / "run/bag/metadata.yaml").exists() == (text is not FULL)
