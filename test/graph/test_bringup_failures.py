"""What a run does when its nodes die or are there already, and when a person stops it.

What it does when they hang is in the sample of the campaign, test_faults.py.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from graphs import (
    Process,
    alive,
    assert_on_loopback_alone,
    messages_of,
    summary_of,
    udp_addresses_of,
    wait_for,
)

from greenroof_ros.model.metrics import METRICS

pytest.importorskip("rclpy", reason="the graph needs ROS 2")


def started(
    domain: int, cwd: Path, *arguments: str, ignored: tuple[signal.Signals, ...] = ()
) -> tuple[Process, dict[str, int]]:
    """Start a long run and wait until it is well under way."""
    process = Process(domain, "bringup", "--output", "run", *arguments, cwd=cwd, ignored=ignored)
    process.wait_for_ticks(size=10_000)
    nodes = process.nodes()
    assert sorted(nodes) == ["controller", "plant", "recorder", "weather"]
    return process, nodes


def assert_gone(nodes: dict[str, int]) -> None:
    """No process of the run is left."""
    assert not [name for name, pid in nodes.items() if alive(pid)]


def assert_ended_early(process: Process, status: str, reason: str) -> None:
    """The run says how and where it ended, and how to open what was recorded."""
    run = process.cwd / "run"
    summary = summary_of(run)
    assert summary["status"] == status
    assert summary["reason"] == reason and reason in process.stderr()
    assert (summary["controller"], summary["steps"]) == ("mpc", 43200)
    assert (summary["refused"], summary["parameter_changes"]) == ({}, [])
    assert not [metric.name for metric in METRICS if metric.name in summary]
    commands = [line for line in process.stderr().splitlines() if line.startswith("  greenroof")]
    if (run / "bag" / "metadata.yaml").exists():
        ticks = len(messages_of(run)["/clock"])
        # The last tick was begun. On a busy machine the recorder can lag by as many messages as the
        # plant keeps for it.
        assert ticks - 1 <= summary["last_tick"] <= ticks + 64
        assert f"ticks in {run / 'bag'}: {ticks};" in process.stderr()
        assert f"  ros2 bag info {run / 'bag'}\n" in process.stderr()
        assert commands == [f"  greenroof report {run}"]
    else:
        assert commands == [f"  greenroof {name} {run}" for name in ("recover", "report")]


@pytest.mark.parametrize("cause", ["ctrl-c", "sigterm under nohup", "plant"])
def test_what_ends_a_run(domain: int, tmp_path: Path, cause: str) -> None:
    """A signal or kill -9 of a node: at once, with its name, no traceback, and nothing left.

    After a signal the exit code is 130, and the bag is closed. Ignored signals, as under nohup and
    in a shell's background, end nothing.
    """
    ignored = (signal.SIGHUP, signal.SIGINT) if cause == "sigterm under nohup" else ()
    process, nodes = started(domain, tmp_path, ignored=ignored)
    assert summary_of(tmp_path / "run")["status"] == "running"
    if cause == "plant":
        os.kill(nodes["plant"], signal.SIGKILL)
        code, status, reason = 1, "failed", "node plant ended (SIGKILL)"
    else:
        for signal_number in ignored:
            process.process.send_signal(signal_number)
        process.wait_for_ticks(size=30_000)
        number = signal.SIGTERM if ignored else signal.SIGINT
        process.process.send_signal(number)
        code, status, reason = 130, "interrupted", f"interrupted by {number.name}"
    assert process.wait(300) == code
    assert "Traceback" not in process.stderr()
    assert_gone(nodes)
    assert (tmp_path / "run" / "bag" / "metadata.yaml").exists() or cause == "plant"
    assert_ended_early(process, status, reason)


@pytest.mark.parametrize("delay", [0.0, 0.7])
def test_interrupted_while_starting(domain: int, tmp_path: Path, delay: float) -> None:
    """Ctrl-C at any moment ends the run; a second and a third do not disturb the end."""
    process = Process(domain, "bringup", "--output", "run", cwd=tmp_path)
    wait_for((tmp_path / "run" / "log").exists, 60, "the start of the nodes")
    time.sleep(delay)
    nodes = process.nodes()
    for _ in range(3):
        process.process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    assert process.wait(300) == 130
    assert process.stderr().count("interrupted by SIGINT\n") == 1
    assert summary_of(tmp_path / "run")["status"] == "interrupted"
    assert "Traceback" not in process.stderr()
    assert_gone(nodes)


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
        process = Process(domain, "bringup", "--speed", "20", "--output", "run", "--namespace",
                          "/site1", cwd=tmp_path)
        process.wait_for_ticks(size=0)
        second = Process(domain, "bringup", "--output", "second", "--namespace", "site1",
                         cwd=tmp_path)
        assert second.wait(300) == 3
        assert all(words in second.stderr() for words in ("namespace /site1", "--namespace"))
        assert not (tmp_path / "second").exists()
        for pid in process.nodes().values():
            assert_on_loopback_alone(pid)
        process.process.send_signal(signal.SIGINT)
        assert process.wait(300) == 130
    finally:
        for port in ports:
            port.unlink(missing_ok=True)


def test_nodes_that_are_there_already(domain: int, tmp_path: Path) -> None:
    """Bringup starts no second graph beside nodes that were started by hand."""
    weather = Process(domain, "nodes.weather", cwd=tmp_path)
    wait_for(lambda: udp_addresses_of(weather.process.pid), 60, "the start of the node")
    time.sleep(0.5)  # until it has announced its name
    refused = Process(domain, "bringup", "--output", "run", cwd=tmp_path)
    assert refused.wait(300) == 3
    assert "ROS_DOMAIN_ID" in refused.stderr()  # from bringup, or from the node that detects it
    weather.process.kill()
    weather.process.wait()
