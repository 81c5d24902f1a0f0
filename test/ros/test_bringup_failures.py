"""What a run does when a person stops it, when it is killed, and when a part of it fails."""

from __future__ import annotations

import re
import signal
import time
from contextlib import closing
from pathlib import Path

import pytest
from commands import run_command
from disks import small_disk
from graphs import Process, assert_on_loopback_alone, environment, messages_of, summary_of
from peers import in_domain
from rosbags.highlevel import AnyReader

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

from ros_rig import Observer


def test_what_ends_a_run(domain: int, tmp_path: Path) -> None:
    """A signal: at once, with exit code 130, no traceback, and the bag closed.

    Ignored signals, as under nohup and in a shell's background, end nothing. The run reports how
    and where it ended.
    """
    ignored, run = (signal.SIGHUP, signal.SIGINT), tmp_path / "run"
    process = Process(domain, "bringup", "--output", "run", cwd=tmp_path, ignored=ignored)
    process.wait_for_ticks(size=10_000)
    for signal_number in ignored:
        process.process.send_signal(signal_number)
    process.wait_for_ticks(size=30_000)
    for _ in range(3):  # a second and a third do not disturb the end
        process.process.send_signal(signal.SIGTERM)
        time.sleep(0.05)
    assert process.wait(300) == 130
    printed, summary, ticks = process.stderr(), summary_of(run), len(messages_of(run)["/clock"])
    assert (summary["status"], summary["reason"]) == ("interrupted", "interrupted by SIGTERM")
    assert summary["reason"] in printed and "Traceback" not in printed
    assert f"the unfinished run is in {run}\n" in printed
    # The last tick was begun. On a busy machine the recorder can lag by as many messages as the
    # plant keeps for it.
    assert ticks - 1 <= summary["last_tick"] <= ticks + 64


def recovered_ticks(run: Path, bag: Path) -> int:
    """Recover a run's bag, and return its number of ticks by an independent reader."""
    words = "recover", str(run), "--output", str(bag)
    done = run_command(*words, cwd=run.parent, env=environment(0))
    assert done.returncode == 0, done.stderr
    with AnyReader([bag]) as reader:
        (ticks,) = {connection.msgcount for connection in reader.connections}
    return ticks


def test_kill_leaves_all_but_a_chunk(domain: int, tmp_path: Path) -> None:
    """The bag of a run that was killed is recovered up to the ticks not yet flushed, at most 32."""
    with in_domain(domain), closing(Observer(domain, tmp_path)) as observer:
        levels = observer.collect("/roof/level")
        process = Process(
            domain, "bringup", "--output", "run", "--speed", "50", cwd=tmp_path
        )
        observer.until(lambda: len(levels) > 100, 60, "100 ticks")
        process.process.kill()
        process.process.wait(300)
        for _ in range(64):  # what is on the way to a slow observer
            observer.executor.spin_once(timeout_sec=0.02)
    assert summary_of(tmp_path / "run")["status"] == "running"
    ticks = recovered_ticks(tmp_path / "run", tmp_path / "recovered")
    assert 60 < len(levels) - 40 <= ticks <= len(levels) + 40


def test_full_disk(domain: int, tmp_path: Path) -> None:
    """A disk that fills up is an error that reports it, and the bag can be recovered."""
    disk = tmp_path / "disk"
    with small_disk(disk, "200k"):
        run = disk / "run"
        process = Process(domain, "bringup", "--output", str(run), cwd=tmp_path)
        assert process.wait(120) == 1
        summary = summary_of(run)
        reason = re.fullmatch(
            r".*/bag: No space left on device; "
            r"'greenroof recover .*/bag' restores the first (\d+) ticks of the bag",
            summary["reason"],
        )
        assert summary["status"] == "failed" and reason is not None, summary["reason"]
        assert summary["reason"] in process.stderr() and "Traceback" not in process.stderr()
        on_the_disk = run_command("recover", str(run), cwd=tmp_path, env=environment(domain))
        assert on_the_disk.returncode == 2 and not (run / "bag-recovered").exists()
        assert "cannot be written: No space left on device" in on_the_disk.stderr
        ticks = recovered_ticks(run, tmp_path / "rescued")
    assert ticks == int(reason[1]) > 300
    assert ticks <= summary["last_tick"] <= ticks + 64


def test_a_graph_of_its_own(domain: int, tmp_path: Path) -> None:
    """A second bringup in the namespace exits with code 3 and advice, and the first continues.

    It listens only on 127.0.0.1, and uses no shared memory that others could lock. It also ignores
    a port there left by a process that was killed while making it (full size, but still empty). The
    ports of the domain's first participants are at 7411 + 250 domain + 2 number (RTPS 2.5,
    9.6.2.4).
    """
    ports = [
        Path(f"/dev/shm/fastrtps_port{7411 + 250 * domain + 2 * number}") for number in range(8)
    ]
    for port in ports:
        port.write_bytes(bytes(52400))
    try:
        run = "bringup", "--speed", "20", "--namespace", "site1", "--output"
        first = Process(domain, *run, "run", cwd=tmp_path)
        first.wait_for_ticks(size=0)
        second = Process(domain, *run, "second", cwd=tmp_path)
        assert second.wait(300) == 3 and "namespace /site1" in second.stderr()
        assert not (tmp_path / "second").exists()
        assert_on_loopback_alone(first.process.pid)
        first.process.send_signal(signal.SIGINT)
        assert first.wait(300) == 130
    finally:
        for port in ports:
            port.unlink(missing_ok=True)


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
        return AT_END
"""
FULL = "BagWriter.close = full; os.kill(os.getpid(), signal.SIGTERM)"
# What stands in its code; the exit code, the status, and a line that is printed. The code of a user
# is refused as other wrong input is; what does not answer is a node that failed.
WRONG = {
    "waits for ever": ("IN_TICK", "time.sleep(600)", 1, "failed",
                       "error: did not return within 2 s; it was executing .*mine.py, line 18"),
    "fails": ("IN_TICK", "1 / 0", 2, "failed",
              "error: .*mine.py, line 18: Mine.command: raises Zero"),
    "fails at the end": ("AT_END", "1 / 0", 2, "failed",
                         "error: .*mine.py, line 25: Mine.statistics: raises Zero"),
    "ends, and the disk is full": ("IN_TICK", FULL, 1, "interrupted", "bag: No space left on dev"),
    "no alarms": ("IN_TICK", "Judge.update = None", 0, "done", "may be no alarms: TypeError: "),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_fails_in_a_run(domain: int, tmp_path: Path, case: str) -> None:
    """Its line states the place; the bag is closed if it can be, and the summary states why."""
    name, text, code, status, line = WRONG[case]
    mine = MINE.replace(name, text).replace("IN_TICK", "pass").replace("AT_END", "None")
    (tmp_path / "mine.py").write_text(mine)
    process = Process(
        domain, "bringup", "--controller", "mine:Mine", "--hours", "0.02", "--peer-limit", "2",
        "--speed", "60", "--output", "run", cwd=tmp_path,
    )
    assert process.wait(300) == code, process.stderr()
    summary = summary_of(tmp_path / "run")
    assert summary["status"] == status
    assert re.search(line, process.stderr()) and "Traceback" not in process.stderr()
    assert status != "failed" or f"error: {summary['reason']}\n" in process.stderr()
    assert (tmp_path / "run/bag/metadata.yaml").exists() == (text is not FULL)
