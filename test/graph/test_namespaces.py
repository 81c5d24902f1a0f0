"""Two graphs side by side in one domain, each in a namespace of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from bag_topics import MPC_TOPICS, bag_topics
from commands import run_command
from graphs import Process, bag_file, bring_up, environment, summary_of, wait_for
from mcap.reader import make_reader

pytest.importorskip("rclpy", reason="the graph needs ROS 2")

# Each with a parameter file of its own, which holds in a namespace; the first is of the paper's
# controller.
FILES = {
    "site1": "/**/mpc:\n  ros__parameters:\n    weight: 0.02\n",
    "site2": "/**/onoff:\n  ros__parameters:\n    fraction: 0.4\n",
}
OPTIONS = {
    "site1": ("--namespace", "site1", "--controller", "mpc", "--hours", "0.1"),
    "site2": ("--namespace", "/site2", "--controller", "onoff", "--hours", "0.1"),
}
TOPICS = {"site1": MPC_TOPICS, "site2": bag_topics()}


def options(cwd: Path, site: str) -> tuple[str, ...]:
    """Return a site's options; its parameter file is written."""
    file = cwd / f"{site}.yaml"
    file.write_text(FILES[site])
    return (*OPTIONS[site], "--parameters", file.name)


def bag_names(run: Path) -> set[str]:
    """Return the names of the topics in a bag."""
    with bag_file(run).open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return {channel.topic for channel in summary.channels.values()}


def test_two_at_once(domain: int, tmp_path: Path) -> None:
    """Their bags have each byte of those of runs alone, and names in their namespace.

    So they have beside a third, of which a node is killed: its run ends.
    """
    killed = Process(
        domain, "bringup", "--output", "run", "--namespace", "site3", "--speed", "20", cwd=tmp_path
    )
    killed.wait_for_ticks(size=0)
    together = {
        site: Process(
            domain, "bringup", "--output", f"{site}-together", *options(tmp_path, site),
            cwd=tmp_path,
        )
        for site in OPTIONS
    }
    file = bag_file(tmp_path / "site2-together")
    wait_for(lambda: file.exists() and file.stat().st_size > 10_000, 60, "a bag")
    os.kill(killed.nodes()["weather"], signal.SIGKILL)
    assert killed.wait(300) == 1
    assert "node weather ended (SIGKILL)" in killed.stderr()
    for process in together.values():
        assert process.wait(120) == 0, process.stderr()
    for site in OPTIONS:
        bring_up(domain, tmp_path, *options(tmp_path, site), output=f"{site}-alone")
        alone, beside = tmp_path / f"{site}-alone", tmp_path / f"{site}-together"
        assert bag_file(beside).read_bytes() == bag_file(alone).read_bytes()
        metadata = Path("bag") / "metadata.yaml"
        assert (beside / metadata).read_bytes() == (alone / metadata).read_bytes()
        assert bag_names(beside) == {f"/{site}{topic}" for topic in TOPICS[site]}
    assert summary_of(tmp_path / "site1-together")["parameters"]["weight"] == 0.02
    # The file took effect in the node: on/off commands its fraction, and nothing else.
    assert summary_of(tmp_path / "site2-together")["max_command"] == 0.4
    # What is recorded under a namespace is recovered under it.
    done = subprocess.run(
        [
            sys.executable, "-m", "greenroof_ros.recover", "site1-alone",
            "--output", str(tmp_path / "again" / "bag"),
        ],
        cwd=tmp_path, env=environment(domain), capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
    assert bag_file(tmp_path / "again").read_bytes() == (
        bag_file(tmp_path / "site1-alone").read_bytes()
    )


@pytest.mark.parametrize("name", ["site 1", "1", "a//b", "roof-1"])
def test_wrong_namespace(unused_domain: int, tmp_path: Path, name: str) -> None:
    """What ROS does not take as a namespace is refused before anything starts."""
    done = run_command("bringup", "--namespace", name, cwd=tmp_path, env=environment(unused_domain))
    assert done.returncode == 2
    assert name in done.stderr
    assert "such as site1" in done.stderr
